// A force that moves over the surface, 60 times a second: ./loop export/runtime.safetensors [frames [newtons]]
// g++ -std=c++17 -O3 -march=native loop.cpp -o loop
#include <chrono>
#include <cstdlib>
#include <iostream>
#include <thread>

#include "dpl_runtime.hpp"

int main(int argc, char** argv) try {
  using Clock = std::chrono::steady_clock;
  if (argc < 2) throw dpl::Error("usage: loop RUNTIME_FILE [frames [newtons]]");
  dpl::Simulator sim = dpl::Simulator::open(argv[1]);
  const int frames = argc > 2 ? std::atoi(argv[2]) : 180;
  const double newtons = argc > 3 ? std::atof(argv[3]) : 1.0;

  std::array<double, 3> low, high;  // corners of the body [m]
  low.fill(1e300), high.fill(-1e300);
  for (std::size_t k = 0; k < sim.points().size(); ++k) {
    low[k % 3] = std::min(low[k % 3], sim.points()[k]);
    high[k % 3] = std::max(high[k % 3], sim.points()[k]);
  }
  std::cout << sim.nodes() << " nodes, " << sim.surface().size() << " of the surface\n"
            << "frame time_ms largest_m error residual min_det_F range\n";
  std::vector<double> force(3 * sim.nodes());
  auto next = Clock::now();
  for (int frame = 0; frame < frames; ++frame) {
    std::array<double, 3> centre = high;  // moves along the first axis on the upper edge and back
    const double place = 0.5 - 0.5 * std::cos(2 * 3.14159265 * frame / 180);
    centre[0] = low[0] + place * (high[0] - low[0]);

    const auto begin = Clock::now();
    std::fill(force.begin(), force.end(), 0.0);
    sim.add_force(sim.patch_around(centre, 0.1 * (high[0] - low[0])), {0, 0, -newtons}, force.data());
    const dpl::Answer& answer = sim.solve(force.data());
    const std::chrono::duration<double, std::milli> taken = Clock::now() - begin;

    double largest = 0;
    for (double u : answer.displacement) largest = std::max(largest, std::abs(u));
    std::cout << frame << ' ' << taken.count() << ' ' << largest << ' ' << answer.error << ' ' << answer.residual
              << ' ' << answer.min_det_F << ' '
              << (answer.range == dpl::Range::inside ? "inside" : answer.range == dpl::Range::outside ? "outside" : "unknown")
              << '\n';
    std::this_thread::sleep_until(next += std::chrono::microseconds(1000000 / 60));
  }
} catch (const std::exception& error) {
  std::cerr << "error: " << error.what() << '\n';
  return 1;
}
