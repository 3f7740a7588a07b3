// g++ -std=c++17 -O3 -march=native -shared -fPIC dpl_c.cpp -o libdpl.so; see dpl_c.h
#include "dpl_c.h"

#include "dpl_runtime.hpp"

namespace {
thread_local std::string message;

template <class Function> int guarded(const void* body, Function&& function) {
  try {
    if (!body) throw dpl::Error("body = NULL must be a result of dpl_open");
    function();
    return 0;
  } catch (const std::exception& error) {
    message = error.what();
    return -1;
  }
}
const dpl::Simulator& simulator(const void* body) { return *static_cast<const dpl::Simulator*>(body); }
template <class T> void copy(const std::vector<T>& from, T* to) { std::copy(from.begin(), from.end(), to); }
}  // namespace

extern "C" {

void* dpl_open(const char* path) {
  dpl::Simulator* body = nullptr;
  guarded(path, [&] { body = new dpl::Simulator(dpl::Simulator::open(path)); });
  return body;
}
void dpl_close(void* body) { delete static_cast<dpl::Simulator*>(body); }
const char* dpl_message(void) { return message.c_str(); }

int dpl_node_count(const void* body) { return body ? simulator(body).nodes() : 0; }
int dpl_points(const void* body, double* points) {
  return guarded(body, [&] { copy(simulator(body).points(), points); });
}
int dpl_surface_count(const void* body) { return body ? int(simulator(body).surface().size()) : 0; }
int dpl_surface(const void* body, int* nodes) {
  return guarded(body, [&] { copy(simulator(body).surface(), nodes); });
}
int dpl_triangle_count(const void* body) { return body ? int(simulator(body).triangles().size() / 3) : 0; }
int dpl_triangles(const void* body, int* nodes) {
  return guarded(body, [&] { copy(simulator(body).triangles(), nodes); });
}
int dpl_add_patch_force(const void* body, const char* patch, const double* total, double* force) {
  return guarded(body, [&] {
    const auto found = simulator(body).patches().find(patch);
    if (found == simulator(body).patches().end()) throw dpl::Error(std::string("patch = ") + patch + " does not exist");
    dpl::Simulator::add_force(found->second, {total[0], total[1], total[2]}, force);
  });
}
int dpl_add_force_around(const void* body, const double* centre, double radius, const double* total, double* force) {
  return guarded(body, [&] {
    const dpl::Patch patch = simulator(body).patch_around({centre[0], centre[1], centre[2]}, radius);
    dpl::Simulator::add_force(patch, {total[0], total[1], total[2]}, force);
  });
}
int dpl_set_young(void* body, double young) {
  return guarded(body, [&] {
    if (!(young > 0) || !std::isfinite(young)) throw dpl::Error("young must be above 0 [Pa]");
    static_cast<dpl::Simulator*>(body)->young = young;
  });
}
int dpl_solve(void* body, const double* force, double* displacement, double* surface, DplReport* report) {
  return guarded(body, [&] {
    dpl::Simulator& sim = *static_cast<dpl::Simulator*>(body);
    const dpl::Answer& answer = sim.solve(force);
    if (displacement) copy(answer.displacement, displacement);
    if (surface)
      for (int node : sim.surface()) surface = std::copy_n(answer.displacement.data() + 3 * node, 3, surface);
    if (report)
      *report = {answer.error, answer.residual, answer.min_det_F, answer.amplitude, answer.out_of_span, int(answer.range)};
  });
}
}
