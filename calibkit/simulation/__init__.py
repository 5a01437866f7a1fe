"""Seeded synthetic rigs and recordings with known truth."""
