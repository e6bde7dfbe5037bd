"""The `pred` command line."""
