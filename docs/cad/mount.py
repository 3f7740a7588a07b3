"""Draw a rubber mount with Gmsh and write mount.msh: quadratic tetrahedra, millimetres."""

import gmsh

gmsh.initialize()
cad, groups = gmsh.model.occ, gmsh.model.addPhysicalGroup
column = cad.addCylinder(0, 0, 0, 0, 0, 30, 12)  # 24 x 24 x 30 mm
waist = cad.addTorus(0, 0, 15, 30, 21)  # leaves 18 mm at half height
body, _ = cad.cut([(3, column)], [(3, waist)])
cad.synchronize()
groups(3, [tag for _, tag in body], name="rubber")
for name, z in (("foot", 0), ("top", 30)):
    faces = gmsh.model.getEntitiesInBoundingBox(-13, -13, z - 0.1, 13, 13, z + 0.1, 2)
    groups(2, [tag for _, tag in faces], name=name)
gmsh.option.setNumber("Mesh.MeshSizeMax", 5)  # [mm]
gmsh.option.setNumber("Mesh.ElementOrder", 2)  # quadratic tetrahedra
gmsh.model.mesh.generate(3)
gmsh.write("mount.msh")
