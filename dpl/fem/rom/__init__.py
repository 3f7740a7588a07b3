"""Reduced-order models: POD, cubature of cells (ECSW), Galerkin projection."""
