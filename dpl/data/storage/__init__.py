"""Data sets on disk: shards, their manifest, their acceptance and their integrity."""
