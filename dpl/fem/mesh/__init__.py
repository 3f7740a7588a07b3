"""Meshes: made, read from files, checked and written; regions of a body."""
