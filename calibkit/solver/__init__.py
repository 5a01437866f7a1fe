"""Least squares for every problem: arrowhead structure, robust loss, covariance, observability."""
