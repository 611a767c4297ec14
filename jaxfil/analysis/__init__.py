"""Analyses on top of the integrator."""
