"""Hidden effects, written against MuJoCo's own API."""
