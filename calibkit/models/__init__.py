"""Sensor and target models: equations with analytic Jacobians."""
