// Evaluate an exported surrogate with ONNX Runtime: ./consumer runs/mine/export [tolerance]
#include <onnxruntime_cxx_api.h>

#include <cmath>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

std::vector<double> read(const std::string& path) {  // float64, little-endian
  std::ifstream file(path, std::ios::binary);
  std::vector<double> numbers;
  for (double x; file.read(reinterpret_cast<char*>(&x), sizeof x);) numbers.push_back(x);
  return numbers;
}

int main(int argc, char** argv) {
  if (argc < 2) return std::cerr << "consumer FOLDER [tolerance]\n", 2;
  const std::string folder = argv[1];
  Ort::Env env;
  Ort::Session session(env, (folder + "/model.onnx").c_str(), Ort::SessionOptions{});
  Ort::AllocatorWithDefaultOptions memory;
  const auto cpu = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);

  // force (B, N, D) [N], young (B,) [Pa] and, if the law has ranges, parameters (B, P)
  std::vector<std::string> names;
  std::vector<std::vector<double>> data;
  std::vector<Ort::Value> inputs;
  for (size_t k = 0; k < session.GetInputCount(); ++k) {
    names.emplace_back(session.GetInputNameAllocated(k, memory).get());
    data.push_back(read(folder + "/reference/" + names.back() + ".f64"));
    auto shape = session.GetInputTypeInfo(k).GetTensorTypeAndShapeInfo().GetShape();
    shape[0] = 1;  // the batch
    inputs.push_back(Ort::Value::CreateTensor<double>(cpu, data.back().data(), data.back().size(),
                                                      shape.data(), shape.size()));
  }
  std::vector<const char*> input_names;
  for (const auto& name : names) input_names.push_back(name.c_str());
  const char* output_names[] = {"displacement"};  // (B, N, D) [m]
  const auto outputs = session.Run({}, input_names.data(), inputs.data(), inputs.size(),
                                   output_names, 1);
  const double* displacement = outputs[0].GetTensorData<double>();

  double difference = 0, size = 0;
  const auto expected = read(folder + "/reference/displacement.f64");
  for (size_t i = 0; i < expected.size(); ++i) {
    difference += std::pow(displacement[i] - expected[i], 2);
    size += std::pow(expected[i], 2);
  }
  const double error = std::sqrt(difference / size);
  std::cout << expected.size() << " numbers, " << error << " from the reference\n";
  return !(error <= (argc > 2 ? std::stod(argv[2]) : 1e-4));
}
