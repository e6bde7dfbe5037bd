"""Scores of models on measured episodes: protocol, splits, statistics, figures and the report."""
