// A pool for short parallel loops: the caller works too and never waits for a thread to wake up.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

namespace mass {

class ThreadPool {
public:
    ThreadPool();
    ~ThreadPool();
    ThreadPool(const ThreadPool&) = delete;
    ThreadPool& operator=(const ThreadPool&) = delete;

    // Calls body(i) for every i in [0, count), on at most `threads` threads (this one included). One loop at a time:
    // a second caller waits. After a fork the child starts threads of its own.
    void loop(int count, int threads, const std::function<void(int)>& body);

private:
    struct State;
    void grow(int workers);

    std::mutex one_loop_;
    std::unique_ptr<State> state_;
    int64_t owner_ = 0;  // process id
};

}  // namespace mass
