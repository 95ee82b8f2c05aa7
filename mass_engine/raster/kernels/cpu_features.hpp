// What this machine can run. Baseline code only: never include it where instruction sets are switched on.
#pragma once

#include <stdexcept>
#include <string>
#include <vector>

namespace mass {

#if defined(MASS_BUILD_X86)
inline bool has_avx512() {
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512bw");
}

inline bool has_avx2() {
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
}
#endif

// The table called `name` ("auto": the first) of those this machine can run. Throws std::invalid_argument.
template <class Table>
const Table* choose_table(const std::vector<const Table*>& found, const std::string& name) {
    for (const Table* table : found) {
        if (name == "auto" || name == table->name) return table;
    }
    throw std::invalid_argument("this machine or build has no instruction set " + name);
}

}  // namespace mass
