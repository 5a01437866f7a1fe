"""Rotations and rigid motions, batch-first, numpy only."""
