"""`unrolled`: an unrolled modified Newton iteration in reduced coordinates with fitted maps."""
