"""Nouns that every stage shares: errors, channels, episodes, protocols, recipes, artifacts, rotations.

Depends on numpy and the standard library only.
"""
