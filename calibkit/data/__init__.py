"""Frozen records that the stages pass on: observations, the rig, results."""
