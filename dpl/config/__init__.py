"""Configurations: checked, built into scenes and networks, kept in the folder of a run."""
