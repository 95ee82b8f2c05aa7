#include "thread_pool.hpp"

#if defined(_WIN32)
#include <process.h>
#define MASS_GETPID _getpid
#else
#include <unistd.h>
#define MASS_GETPID getpid
#endif

namespace mass {

// `ticket` holds the loop's generation (high half) and the next index (low half), so that claiming an index and
// checking that the loop is still the same is one compare-and-swap. A closed ticket has no index left.
struct ThreadPool::State {
    static constexpr uint64_t kClosed = 0xffffffffu;
    static constexpr int kSpins = 2000;  // about 20-50 us: the gap between two loops of one frame

    std::atomic<uint64_t> ticket{kClosed};
    std::atomic<const std::function<void(int)>*> body{nullptr};
    std::atomic<uint32_t> count{0};
    std::atomic<uint32_t> finished{0};
    std::atomic<int> helpers{0};  // workers allowed in this loop

    std::mutex mutex;
    std::condition_variable wake;
    std::atomic<int> sleeping{0};
    std::atomic<bool> stop{false};
    std::vector<std::thread> workers;

    static void pause() {
#if defined(__x86_64__) || defined(__i386__)
        __builtin_ia32_pause();
#endif
    }

    void take_part() {
        for (;;) {
            uint64_t seen = ticket.load(std::memory_order_acquire);
            const uint32_t index = static_cast<uint32_t>(seen);
            const auto* work = body.load(std::memory_order_relaxed);
            if (index == kClosed || index >= count.load(std::memory_order_relaxed)) return;
            if (!ticket.compare_exchange_weak(seen, seen + 1, std::memory_order_acq_rel)) continue;
            (*work)(static_cast<int>(index));
            finished.fetch_add(1, std::memory_order_release);
        }
    }

    bool open(int worker) const {
        const uint64_t seen = ticket.load(std::memory_order_acquire);
        const uint32_t index = static_cast<uint32_t>(seen);
        return index != kClosed && index < count.load(std::memory_order_relaxed) &&
               worker < helpers.load(std::memory_order_relaxed);
    }

    void work(int worker) {
        int idle = 0;
        while (!stop.load(std::memory_order_relaxed)) {
            if (open(worker)) {
                take_part();
                idle = 0;
            } else if (++idle < kSpins) {
                pause();
            } else {
                std::unique_lock<std::mutex> lock(mutex);
                sleeping.fetch_add(1);
                wake.wait(lock, [&] { return stop.load() || open(worker); });
                sleeping.fetch_sub(1);
                idle = 0;
            }
        }
    }
};

ThreadPool::ThreadPool() = default;

ThreadPool::~ThreadPool() {
    if (!state_) return;
    if (owner_ != MASS_GETPID()) {  // forked: the threads are not here, and their locks may be held for ever
        (void)state_.release();
        return;
    }
    {
        std::lock_guard<std::mutex> lock(state_->mutex);
        state_->stop = true;
    }
    state_->wake.notify_all();
    for (auto& worker : state_->workers) worker.join();
}

void ThreadPool::grow(int workers) {
    if (state_ && owner_ != MASS_GETPID()) (void)state_.release();
    if (!state_) {
        state_ = std::make_unique<State>();
        owner_ = MASS_GETPID();
    }
    while (static_cast<int>(state_->workers.size()) < workers) {
        const int id = static_cast<int>(state_->workers.size());
        state_->workers.emplace_back([state = state_.get(), id] { state->work(id); });
    }
}

void ThreadPool::loop(int count, int threads, const std::function<void(int)>& body) {
    if (threads <= 1 || count <= 1) {
        for (int i = 0; i < count; ++i) body(i);
        return;
    }
    std::lock_guard<std::mutex> one(one_loop_);
    grow(threads - 1);
    State& s = *state_;
    const uint64_t generation = (s.ticket.load() >> 32) + 1;
    s.ticket.store(generation << 32 | State::kClosed);  // nobody claims while the fields change
    s.body.store(&body);
    s.count.store(static_cast<uint32_t>(count));
    s.finished.store(0);
    s.helpers.store(threads - 1);
    s.ticket.store(generation << 32);
    if (s.sleeping.load() > 0) {
        { std::lock_guard<std::mutex> lock(s.mutex); }
        s.wake.notify_all();
    }
    s.take_part();
    while (s.finished.load(std::memory_order_acquire) != static_cast<uint32_t>(count)) {
        for (int i = 0; i < 200 && s.finished.load(std::memory_order_acquire) != static_cast<uint32_t>(count); ++i) State::pause();
        if (s.finished.load(std::memory_order_acquire) != static_cast<uint32_t>(count)) std::this_thread::yield();
    }
}

}  // namespace mass
