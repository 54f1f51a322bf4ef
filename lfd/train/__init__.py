"""Batches to policies."""
