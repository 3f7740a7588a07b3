// An angle bracket [m]: gmsh -3 bracket.geo -o bracket.msh
// Two bolt holes in the wall plate, a bore in the arm, a fillet in the corner.
SetFactory("OpenCASCADE");
width = 0.06; height = 0.10; reach = 0.12; thick = 0.014; radius = 0.015;

Box(1) = {0, 0, 0, thick, width, height};       // wall plate
Box(2) = {0, 0, 0, reach, width, thick};        // arm
Box(3) = {thick, 0, thick, radius, width, radius};  // corner, with its fillet cut out
Cylinder(4) = {thick + radius, 0, thick + radius, 0, width, 0, radius};
BooleanDifference(5) = { Volume{3}; Delete; }{ Volume{4}; Delete; };
BooleanUnion(6) = { Volume{1}; Delete; }{ Volume{2, 5}; Delete; };
Cylinder(7) = {0, width / 4, 0.08, thick, 0, 0, 0.006};     // bolt holes
Cylinder(8) = {0, 3 * width / 4, 0.08, thick, 0, 0, 0.006};
Cylinder(9) = {0.095, width / 2, 0, 0, 0, thick, 0.013};    // bore
BooleanDifference(10) = { Volume{6}; Delete; }{ Volume{7, 8, 9}; Delete; };

e = 1e-4;
Physical Volume("body") = {10};
wall() = Surface In BoundingBox{-e, -e, -e, e, width + e, height + e};
bore() = Surface In BoundingBox{0.08, width / 2 - 0.014, -e, 0.11, width / 2 + 0.014, thick + e};
seat() = Surface In BoundingBox{thick + radius - e, -e, thick - e, reach + e, width + e, thick + e};
Physical Surface("wall") = wall();
Physical Surface("bore") = bore();
Physical Surface("seat") = seat();
Mesh.MeshSizeMax = 0.011;
Mesh.MeshSizeFromCurvature = 8;
Mesh.MeshSizeMin = 0.004;
