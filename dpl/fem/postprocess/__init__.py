"""What is derived from a displacement: stresses, energies, the surface."""
