// Measure a marker with an exported network, in C++: OpenVINO reads the ONNX file and runs it; no Python takes part.
//
//   imgcal export measurer-cnn --to onnx --out measurer.onnx
//   pip install openvino; OV=$(python -c "import openvino, pathlib; print(pathlib.Path(openvino.__file__).parent)")
//   c++ -std=c++17 -I$OV/include run_onnx.cpp $OV/libs/libopenvino.so.* -Wl,-rpath,$OV/libs -o run_onnx
//   ./run_onnx measurer.onnx < patch.txt
//
// Standard input: the radius (pixels, 3.5 at most), then the 24 x 24 grey values around the marker, row by row.
// Standard output: the centre from the middle of the patch (u, v), its sigma, both in pixels, and whether it is a marker.
#include <algorithm>
#include <cmath>
#include <iostream>
#include <openvino/openvino.hpp>
#include <vector>

constexpr int SIZE = 24;

float median(std::vector<float> values) {  // of two in the middle the lower one
    auto middle = values.begin() + (values.size() - 1) / 2;
    std::nth_element(values.begin(), middle, values.end());
    return *middle;
}

void normalize(std::vector<float>& patch) {  // less its median, over its noise, compressed
    std::vector<float> steps;
    for (int i = 0; i < SIZE * SIZE; ++i)
        if (i % SIZE >= 2) steps.push_back(std::abs(patch[i] - patch[i - 2]));
    float level = median(patch), noise = 1.05f * median(steps), largest = 0;
    for (float value : patch) largest = std::max(largest, std::abs(value - level));
    noise = std::max({noise, largest / 1000, 1e-6f});
    for (float& value : patch) value = std::asinh((value - level) / (2 * noise)) / 2;
}

int main(int count, char** arguments) {
    if (count != 2) return std::cerr << "usage: run_onnx MODEL.onnx < patch.txt\n", 2;
    float radius = 0;
    std::vector<float> patch(SIZE * SIZE);
    std::cin >> radius;
    for (float& value : patch) std::cin >> value;
    if (!std::cin) return std::cerr << "expected a radius and " << SIZE * SIZE << " grey values\n", 2;
    normalize(patch);
    ov::Core core;
    auto request = core.compile_model(arguments[1], "CPU", {{"INFERENCE_PRECISION_HINT", "f32"}}).create_infer_request();
    std::copy(patch.begin(), patch.end(), request.get_tensor("patches").data<float>());
    request.get_tensor("radius").data<float>()[0] = radius;
    request.infer();
    const float *offset = request.get_tensor("offset").data<float>(), *kind = request.get_tensor("kind").data<float>();
    float sum = 0;
    for (int i = 0; i < 4; ++i) sum += std::exp(kind[i] - kind[3]);  // whole, partial, merged, false
    std::cout.precision(9);
    std::cout << offset[0] << ' ' << offset[1] << ' ' << std::exp(request.get_tensor("log_sigma").data<float>()[0]) << ' '
              << 1 - 1 / sum << '\n';
}
