"""What goes round through several stages: short files that call them in order."""
