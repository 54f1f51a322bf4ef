"""Other projects' trainings, each run by a small program in an environment that has that project and not lfd."""
