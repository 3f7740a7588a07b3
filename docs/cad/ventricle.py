"""Draw a ventricle with Gmsh and write ventricle.msh: quadratic tetrahedra, millimetres."""

import math

import gmsh

gmsh.initialize()
gmsh.clear()
cad, halves = gmsh.model.occ, []
for short, long in ((10, 20), (7, 17)):  # half axes of the outer and the inner surface
    halves.append((3, cad.addSphere(0, 0, 0, 1, angle1=-math.pi / 2, angle2=0)))
    cad.dilate(halves[-1:], 0, 0, 0, short, short, long)
wall, _ = cad.cut(halves[:1], halves[1:])
cad.synchronize()
gmsh.model.addPhysicalGroup(3, [tag for _, tag in wall], name="wall")
for _, tag in gmsh.model.getEntities(2):
    _, _, bottom, side, _, top = gmsh.model.getBoundingBox(2, tag)
    name = "base" if top - bottom < 1 else "inner" if side < 8 else "outer"
    gmsh.model.addPhysicalGroup(2, [tag], name=name)
gmsh.option.setNumber("Mesh.MeshSizeMax", 2.5)  # [mm]
gmsh.option.setNumber("Mesh.ElementOrder", 2)  # quadratic tetrahedra
gmsh.model.mesh.generate(3)
gmsh.write("ventricle.msh")
