"""Estimators, one file a problem."""
