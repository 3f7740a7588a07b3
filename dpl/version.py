"""The version, where files that record it can read it without the package's front."""

__version__ = "0.1.0"
