"""What is measured: solvers, networks, meshes and codes, against each other on one machine."""
