"""Elements, boundary conditions, and the assembly of forces and tangents."""
