// Sorting and prefix sums: CUB on a GPU, the standard library in the emulation.
#include "device.hpp"

#include "cuda_frame.hpp"

#if defined(__CUDACC__)
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>
#else
#include <algorithm>
#include <numeric>
#include <vector>
#endif

namespace mass::gpu {

#if defined(__CUDACC__)

std::size_t scratch_bytes(int count) {
    std::size_t sort = 0, sum = 0;
    const uint32_t* in = nullptr;
    uint32_t* out = nullptr;
    check(cub::DeviceRadixSort::SortPairs(nullptr, sort, in, out, in, out, count, 0, 32));
    check(cub::DeviceScan::ExclusiveSum(nullptr, sum, static_cast<const uint64_t*>(nullptr), static_cast<uint64_t*>(nullptr), count + 1));
    return sort > sum ? sort : sum;
}

void sort_by_key(const Call& call, const uint32_t* keys, uint32_t* keys_out, const uint32_t* values, uint32_t* values_out, int count,
                 int bits) {
    if (count == 0) return;
    std::size_t bytes = call.shape.scratch_bytes;
    check(cub::DeviceRadixSort::SortPairs(call.frame.scratch, bytes, keys, keys_out, values, values_out, count, 0, bits,
                                          static_cast<Stream>(call.stream)));
}

void sum_before(const Call& call, const uint64_t* in, uint64_t* out, int count) {
    std::size_t bytes = call.shape.scratch_bytes;
    check(cub::DeviceScan::ExclusiveSum(call.frame.scratch, bytes, in, out, count, static_cast<Stream>(call.stream)));
}

#else

std::size_t scratch_bytes(int) { return 0; }

void sort_by_key(const Call&, const uint32_t* keys, uint32_t* keys_out, const uint32_t* values, uint32_t* values_out, int count, int bits) {
    std::vector<int> order(static_cast<std::size_t>(count));
    std::iota(order.begin(), order.end(), 0);
    const uint32_t mask = bits == 32 ? 0xffffffffu : (1u << bits) - 1u;
    std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return (keys[a] & mask) < (keys[b] & mask); });
    for (int i = 0; i < count; ++i) {
        keys_out[i] = keys[order[static_cast<std::size_t>(i)]];
        values_out[i] = values[order[static_cast<std::size_t>(i)]];
    }
}

void sum_before(const Call&, const uint64_t* in, uint64_t* out, int count) {
    uint64_t sum = 0;
    for (int i = 0; i < count; ++i) {
        out[i] = sum;
        sum += in[i];
    }
}

#endif

}  // namespace mass::gpu
