"""Demonstrators as policies: scripted experts, one file a task, and what varies their demonstrations."""
