// A GPU emulated on the CPU, for tests: one block at a time, a fiber per thread, switched at barriers and warp
// operations only. Slow, exact about who must meet whom, and without races of its own: a kernel that forgets a barrier
// gives other results when the threads run in the opposite order (`reverse`).
#pragma once

#include <csetjmp>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <mutex>
#include <vector>

#include <ucontext.h>

#include "device.hpp"

#define MASS_KERNEL(threads) static void
#define MASS_DEVICE static inline
#define MASS_SHARED static

namespace mass {

using Stream = void*;

namespace emulator {

enum class Wait { kNone, kBlock, kWarp, kDone };

struct Fiber {
    ucontext_t first;
    jmp_buf at;
    bool started = false;
    Wait wait = Wait::kNone;
    int operation = 0;  // which warp operation or barrier it waits at
    unsigned met = 0;   // warp operations so far
    std::unique_ptr<char[]> stack;
};

class Machine {
public:
    static constexpr std::size_t kStack = 128 << 10;

    // Runs `body` for every thread of every block.
    template <typename Body>
    void run(int blocks, int threads, const Body& body) {
        std::lock_guard<std::mutex> lock(mutex_);
        while (fibers_.size() < static_cast<std::size_t>(threads)) {
            fibers_.push_back(std::make_unique<Fiber>());
            fibers_.back()->stack.reset(new char[kStack]);
        }
        call_ = [](const void* b) { (*static_cast<const Body*>(b))(); };
        body_ = &body;
        blocks_ = blocks;
        threads_ = threads;
        exchange_.resize(static_cast<std::size_t>((threads + kWarp - 1) / kWarp));
        for (block_ = 0; block_ < blocks; ++block_) run_block();
    }

    int block() const { return block_; }
    int blocks() const { return blocks_; }
    int thread() const { return thread_; }

    int vote(bool x) {  // a block barrier that also counts
        const int slot = votes_met_[static_cast<std::size_t>(thread_)]++ % 3;
        if (x) ++votes_[slot];
        wait(Wait::kBlock, 1);
        votes_[(slot + 2) % 3] = 0;  // the vote before this one: all have read it, none votes there before the next
        return votes_[slot];
    }

    // Every lane gives 8 bytes and sees what all lanes of its warp gave.
    const uint64_t* meet(uint64_t value, int operation) {
        Fiber& f = *fibers_[static_cast<std::size_t>(thread_)];
        uint64_t* slots = exchange_[static_cast<std::size_t>(thread_ / kWarp)].value[f.met++ & 1];
        slots[thread_ % kWarp] = value;
        wait(Wait::kWarp, operation);
        return slots;
    }

    void wait(Wait what, int operation) {
        Fiber& f = *fibers_[static_cast<std::size_t>(thread_)];
        f.wait = what;
        f.operation = operation;
        if (_setjmp(f.at) == 0) _longjmp(scheduler_, 1);
    }

    bool reverse = false;

private:
    struct Exchange {
        uint64_t value[2][kWarp];
    };

    static void enter();

    void run_block() {
        for (int t = 0; t < threads_; ++t) {
            Fiber& f = *fibers_[static_cast<std::size_t>(t)];
            f.started = false;
            f.wait = Wait::kNone;
            f.met = 0;
        }
        votes_[0] = votes_[1] = votes_[2] = 0;
        votes_met_.assign(static_cast<std::size_t>(threads_), 0);
        done_ = 0;
        while (done_ < threads_) {
            bool ran = false;
            for (int k = 0; k < threads_; ++k) {
                const int t = reverse ? threads_ - 1 - k : k;
                if (fibers_[static_cast<std::size_t>(t)]->wait != Wait::kNone) continue;
                ran = true;
                resume(t);
            }
            if (!release() && !ran) {
                throw DeviceError("emulated kernel: threads wait for others that never come");
            }
        }
    }

    __attribute__((noinline)) void resume(int t) {
        thread_ = t;
        Fiber& f = *fibers_[static_cast<std::size_t>(t)];
        if (_setjmp(scheduler_) != 0) return;
        if (f.started) _longjmp(f.at, 1);
        f.started = true;
        getcontext(&f.first);
        f.first.uc_stack.ss_sp = f.stack.get();
        f.first.uc_stack.ss_size = kStack;
        f.first.uc_link = nullptr;
        makecontext(&f.first, &Machine::enter, 0);
        setcontext(&f.first);
    }

    // Lets warps and the block go on that wait as a whole. Did any?
    bool release() {
        bool any = false;
        for (int first = 0; first < threads_; first += kWarp) {
            const int end = first + kWarp < threads_ ? first + kWarp : threads_;
            any |= release(first, end, Wait::kWarp);
        }
        return release(0, threads_, Wait::kBlock) || any;
    }

    bool release(int begin, int end, Wait what) {
        const int operation = fibers_[static_cast<std::size_t>(begin)]->operation;
        for (int t = begin; t < end; ++t) {
            const Fiber& f = *fibers_[static_cast<std::size_t>(t)];
            if (f.wait != what) return false;
            if (f.operation != operation) throw DeviceError("emulated kernel: threads met at different operations");
        }
        for (int t = begin; t < end; ++t) fibers_[static_cast<std::size_t>(t)]->wait = Wait::kNone;
        return true;
    }

    std::mutex mutex_;
    std::vector<std::unique_ptr<Fiber>> fibers_;
    std::vector<Exchange> exchange_;
    std::vector<int> votes_met_;
    int votes_[3] = {0, 0, 0};
    jmp_buf scheduler_;
    void (*call_)(const void*) = nullptr;
    const void* body_ = nullptr;
    int blocks_ = 0, threads_ = 0, block_ = 0, thread_ = 0, done_ = 0;
};

inline Machine& machine() {
    static Machine made;
    return made;
}

inline void Machine::enter() {
    Machine& m = machine();
    m.call_(m.body_);
    m.fibers_[static_cast<std::size_t>(m.thread_)]->wait = Wait::kDone;
    ++m.done_;
    _longjmp(m.scheduler_, 1);
}

template <typename T>
uint64_t packed(T x) {
    static_assert(sizeof(T) <= 8, "a lane gives at most 8 bytes");
    uint64_t r = 0;
    std::memcpy(&r, &x, sizeof x);
    return r;
}

template <typename T>
T unpacked(uint64_t x) {
    T r;
    std::memcpy(&r, &x, sizeof r);
    return r;
}

template <typename T>
T warp_xor(T x, int mask) {
    return unpacked<T>(machine().meet(packed(x), 16 + mask)[(machine().thread() % kWarp) ^ mask]);
}

}  // namespace emulator

namespace device {

MASS_DEVICE int block_index() { return emulator::machine().block(); }
MASS_DEVICE int block_count() { return emulator::machine().blocks(); }
MASS_DEVICE int thread_index() { return emulator::machine().thread(); }
MASS_DEVICE void sync_block() { emulator::machine().wait(emulator::Wait::kBlock, 0); }
MASS_DEVICE bool sync_block_or(bool x) { return emulator::machine().vote(x) != 0; }
MASS_DEVICE void sync_warp() { emulator::machine().meet(0, 1); }
MASS_DEVICE unsigned warp_ballot(bool x) {
    const uint64_t* given = emulator::machine().meet(x, 2);
    unsigned r = 0;
    for (int l = 0; l < kWarp; ++l) r |= static_cast<unsigned>(given[l] != 0) << l;
    return r;
}
MASS_DEVICE bool warp_any(bool x) { return warp_ballot(x) != 0; }
MASS_DEVICE float warp_xor(float x, int mask) { return emulator::warp_xor(x, mask); }
MASS_DEVICE double warp_xor(double x, int mask) { return emulator::warp_xor(x, mask); }
MASS_DEVICE int warp_xor(int x, int mask) { return emulator::warp_xor(x, mask); }
MASS_DEVICE void atomic_add(int* p, int x) { *p += x; }
MASS_DEVICE void atomic_or(int* p, int x) { *p |= x; }
MASS_DEVICE int lowest_bit(unsigned x) { return __builtin_ffs(static_cast<int>(x)) - 1; }
MASS_DEVICE int highest_bit(unsigned x) { return x == 0 ? -1 : 31 - __builtin_clz(x); }

}  // namespace device

template <typename... Parameters, typename... Arguments>
void launch(void (*kernel)(Parameters...), int blocks, int threads, Stream, Arguments... arguments) {
    if (blocks > 0) emulator::machine().run(blocks, threads, [&] { kernel(arguments...); });
}

inline void fill_bytes(void* p, int value, std::size_t bytes, Stream) {
    if (bytes > 0) std::memset(p, value, bytes);
}

class DeviceGuard {
public:
    explicit DeviceGuard(int) {}
};

inline std::string device_problem() { return {}; }

}  // namespace mass
