"""Bags and data sets: the wire contract in MCAP files, read and written without a ROS installation."""
