// Memory that is kept between frames and never shrinks.
#pragma once

#include <cstddef>
#include <new>

namespace mass {

template <typename T>
class Buffer {
public:
    Buffer() = default;
    ~Buffer() { release(); }
    Buffer(Buffer&& other) noexcept : data_(other.data_), capacity_(other.capacity_) {
        other.data_ = nullptr;
        other.capacity_ = 0;
    }
    Buffer& operator=(Buffer&&) = delete;

    // At least `count` values, contents undefined. An eighth more than asked for, so that slowly growing demand does
    // not allocate every frame.
    T* reserve(std::size_t count) {
        if (count > capacity_) {
            release();
            const std::size_t wanted = count + count / 8 + 64;
            data_ = static_cast<T*>(::operator new(wanted * sizeof(T), std::align_val_t{64}));
            capacity_ = wanted;
        }
        return data_;
    }
    T* data() const { return data_; }
    std::size_t bytes() const { return capacity_ * sizeof(T); }

private:
    void release() {
        if (data_) ::operator delete(data_, std::align_val_t{64});
        data_ = nullptr;
        capacity_ = 0;
    }

    T* data_ = nullptr;
    std::size_t capacity_ = 0;
};

}  // namespace mass
