"""Samples: drawn, solved, kept on disk, streamed, handed to Lightning."""
