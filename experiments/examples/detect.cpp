// Detects boxes in one point cloud with onnxruntime: detect GRAPH.onnx CLOUD.bin COLUMNS
// The cloud holds rows of COLUMNS float32: x, y, z, intensity, and the time lag if there are five or more.
// Prints one line per box: label, score, x, y, z, l, w, h, yaw, vx, vy. docs/export.md tells how to compile it.
#include <onnxruntime_c_api.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <memory>
#include <vector>

static const OrtApi *api = OrtGetApiBase()->GetApi(ORT_API_VERSION);

static void check(OrtStatus *status) {
  if (!status) return;
  std::fprintf(stderr, "%s\n", api->GetErrorMessage(status));
  std::exit(1);
}

static std::vector<int64_t> shape_of(OrtTypeInfo *type) {
  const OrtTensorTypeAndShapeInfo *tensor;
  size_t rank;
  check(api->CastTypeInfoToTensorInfo(type, &tensor));
  check(api->GetDimensionsCount(tensor, &rank));
  std::vector<int64_t> shape(rank);
  check(api->GetDimensions(tensor, shape.data(), rank));
  api->ReleaseTypeInfo(type);
  return shape;
}

template <typename T>
static const T *data(OrtValue *value) {
  void *content;
  check(api->GetTensorMutableData(value, &content));
  return static_cast<const T *>(content);
}

int main(int count, char **words) {
  const int64_t columns = count == 4 ? std::atoi(words[3]) : 0;
  std::ifstream file(count == 4 ? words[2] : "", std::ios::binary | std::ios::ate);
  if (!file || columns < 4) {
    std::fprintf(stderr, "usage: detect GRAPH.onnx CLOUD.bin COLUMNS, with at least four columns\n");
    return 1;
  }
  std::vector<float> cloud(file.tellg() / sizeof(float));
  if (int64_t(file.tellg()) % (columns * sizeof(float))) {
    std::fprintf(stderr, "%s: found %lld bytes, expected rows of %lld float32\n", words[2], (long long)file.tellg(),
                 (long long)columns);
    return 1;
  }
  file.seekg(0).read(reinterpret_cast<char *>(cloud.data()), cloud.size() * sizeof(float));

  if (!api) {
    std::fprintf(stderr, "the library of onnxruntime is older than its headers\n");
    return 1;
  }
  OrtEnv *env;
  OrtSessionOptions *options;
  OrtSession *session;
  check(api->CreateEnv(ORT_LOGGING_LEVEL_WARNING, "detect", &env));
  check(api->CreateSessionOptions(&options));
  check(api->CreateSession(env, words[1], options, &session));

  OrtTypeInfo *cloud_type, *boxes_type;
  check(api->SessionGetInputTypeInfo(session, 0, &cloud_type));
  check(api->SessionGetOutputTypeInfo(session, 0, &boxes_type));
  const std::vector<int64_t> shape = shape_of(cloud_type);  // rows and columns of a padded cloud
  const int64_t number = shape_of(boxes_type)[0];
  const int64_t rows = cloud.size() / columns, kept = std::min(columns, shape[1]);
  if (rows > shape[0]) {
    std::fprintf(stderr, "%s: found %ld rows, expected at most %ld\n", words[2], long(rows), long(shape[0]));
    return 1;
  }
  std::vector<float> points(shape[0] * shape[1]);
  std::unique_ptr<bool[]> valid(new bool[shape[0]]());
  for (int64_t row = 0; row < rows; ++row) {
    std::copy_n(&cloud[row * columns], kept, &points[row * shape[1]]);
    valid[row] = true;
  }

  OrtMemoryInfo *memory;
  OrtValue *inputs[2] = {}, *outputs[4] = {};
  const char *names[] = {"points", "valid"}, *results[] = {"boxes", "scores", "labels", "used"};
  check(api->CreateCpuMemoryInfo(OrtArenaAllocator, OrtMemTypeDefault, &memory));
  check(api->CreateTensorWithDataAsOrtValue(memory, points.data(), points.size() * sizeof(float), shape.data(), 2,
                                            ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT, &inputs[0]));
  check(api->CreateTensorWithDataAsOrtValue(memory, valid.get(), shape[0], shape.data(), 1,
                                            ONNX_TENSOR_ELEMENT_DATA_TYPE_BOOL, &inputs[1]));
  check(api->Run(session, nullptr, names, inputs, 2, results, 4, outputs));

  const float *boxes = data<float>(outputs[0]), *scores = data<float>(outputs[1]);
  const int64_t *labels = data<int64_t>(outputs[2]);
  const bool *used = data<bool>(outputs[3]);
  for (int64_t box = 0; box < number && used[box]; ++box) {
    std::printf("%ld %.4f", long(labels[box]), scores[box]);
    for (int i = 0; i < 9; ++i) std::printf(" %.3f", boxes[9 * box + i]);
    std::printf("\n");
  }
}
