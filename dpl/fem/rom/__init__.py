"""Reduced-order models: POD, cubature of cells (ECSW), Newton's method in a subspace."""
