"""Policies to reports: evaluation with intervals."""
