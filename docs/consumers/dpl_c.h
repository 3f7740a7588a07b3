/* C interface of dpl_runtime.hpp, for C#, Python's ctypes and other languages; see docs/consumers.md.
   No function throws. Those that return a status return 0, or -1 and leave a line in dpl_message(). */
#pragma once

#if defined(_WIN32)
#define DPL_API __declspec(dllexport)
#else
#define DPL_API __attribute__((visibility("default")))
#endif

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
  double error, residual, min_det_F, amplitude, out_of_span; /* as of dpl::Answer */
  int range;                                                 /* 1: inside, 0: outside, -1: unknown */
} DplReport;

DPL_API void* dpl_open(const char* path);  /* NULL where it fails */
DPL_API void dpl_close(void* body);
DPL_API const char* dpl_message(void);     /* the last error of this thread */

/* Each count is followed by a function that copies so many items; arrays of the caller. */
DPL_API int dpl_node_count(const void* body);
DPL_API int dpl_points(const void* body, double* points);          /* (N, 3) [m] */
DPL_API int dpl_surface_count(const void* body);
DPL_API int dpl_surface(const void* body, int* nodes);             /* (S,) */
DPL_API int dpl_triangle_count(const void* body);
DPL_API int dpl_triangles(const void* body, int* nodes);           /* (T, 3), outward normals */

/* Add a total force (3,) [N] on a patch, or around a point [m], to nodal forces (N, 3) [N]. */
DPL_API int dpl_add_patch_force(const void* body, const char* patch, const double* total, double* force);
DPL_API int dpl_add_force_around(const void* body, const double* centre, double radius, const double* total,
                                 double* force);

DPL_API int dpl_set_young(void* body, double young); /* [Pa] */
/* Displacements [m] of all nodes (N, 3) and of the surface (S, 3); any of the outputs may be NULL. */
DPL_API int dpl_solve(void* body, const double* force, double* displacement, double* surface, DplReport* report);

#ifdef __cplusplus
}
#endif
