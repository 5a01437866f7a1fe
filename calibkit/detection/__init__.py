"""Boards found in images."""
