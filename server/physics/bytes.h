// Little-endian binary reading and writing. Doubles travel as their bits.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <string>
#include <string_view>
#include <type_traits>

namespace aureole::physics {

static_assert(std::endian::native == std::endian::little, "values are copied as they are");

// Appends to a string; what was put is there when the writer is gone. In blocks, which is several times as fast as
// value by value.
class ByteWriter {
 public:
  explicit ByteWriter(std::string* out) : out_(out) {}
  ~ByteWriter() { Flush(); }
  ByteWriter(const ByteWriter&) = delete;
  ByteWriter& operator=(const ByteWriter&) = delete;

  template <class T>
  void Put(T value) {
    static_assert(std::is_arithmetic_v<T> && !std::is_same_v<T, bool>);
    if (sizeof block_ - size_ < sizeof value) Flush();
    std::memcpy(block_ + size_, &value, sizeof value);
    size_ += sizeof value;
  }
  // Length (32 bit), then the bytes.
  void PutString(std::string_view s) {
    Put(static_cast<uint32_t>(s.size()));
    Flush();
    out_->append(s);
  }

 private:
  void Flush() {
    out_->append(block_, size_);
    size_ = 0;
  }

  std::string* const out_;
  size_t size_ = 0;  // in the block
  char block_[4096];
};

// Reads past the end yield zeros and make the reader fail for good, so that a parser may check once per part.
class ByteReader {
 public:
  explicit ByteReader(std::string_view bytes) : rest_(bytes) {}

  template <class T>
  T Get() {
    static_assert(std::is_arithmetic_v<T> && !std::is_same_v<T, bool>);
    T value{};
    if (rest_.size() < sizeof value) {
      Fail();
      return value;
    }
    std::memcpy(&value, rest_.data(), sizeof value);
    rest_.remove_prefix(sizeof value);
    return value;
  }
  // A double of magnitude at most `bound`; anything else fails.
  double GetFinite(double bound) {
    const double x = Get<double>();
    if (std::abs(x) <= bound) return x;
    Fail();
    return 0;
  }
  std::string_view GetString() {
    const uint32_t size = Get<uint32_t>();
    if (size > rest_.size()) {
      Fail();
      return {};
    }
    const std::string_view s = rest_.substr(0, size);
    rest_.remove_prefix(size);
    return s;
  }
  // How many items follow, each of at least `item` bytes; more than can be there fails.
  uint32_t GetCount(size_t item) {
    const uint32_t count = Get<uint32_t>();
    if (count <= rest_.size() / item) return count;
    Fail();
    return 0;
  }
  void Fail() {
    failed_ = true;
    rest_ = {};
  }
  bool ok() const { return !failed_; }
  bool done() const { return !failed_ && rest_.empty(); }

 private:
  std::string_view rest_;
  bool failed_ = false;
};

}  // namespace aureole::physics
