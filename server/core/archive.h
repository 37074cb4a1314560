// Saves values as bytes and loads them again, with one description for both ways: a class has
//   template <class Archive> void Visit(Archive& a) { a(first_, second_); }
// For checkpoints, which the program that wrote them reads: no versions, no byte order, no evolution. Who keeps bytes
// where they can be damaged adds a check sum; the reader only takes care not to run over their end.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstring>
#include <deque>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>
#include <vector>

#include <absl/container/flat_hash_map.h>

#include "server/core/scene.h"
#include "server/core/types.h"

namespace aureole {

template <class Archive>
void Visit(Archive& a, Box& v) {
  a(v.min, v.max);
}
template <class Archive>
void Visit(Archive& a, ChildShape& v) {
  a(v.position, v.orientation, v.shape);
}
template <class Archive>
void Visit(Archive& a, Shape& v) {
  a(v.kind, v.radius, v.half, v.normal, v.offset, v.points, v.triangles, v.children, v.rows, v.columns, v.cell,
    v.heights);
}
template <class Archive>
void Visit(Archive& a, Material& v) {
  a(v.friction, v.rolling_friction, v.spinning_friction, v.restitution, v.linear_damping, v.angular_damping);
}
template <class Archive>
void Visit(Archive& a, Script::Key& v) {
  a(v.time, v.position, v.orientation);
}
template <class Archive>
void Visit(Archive& a, Script& v) {
  a(v.keys, v.period);
}
template <class Archive>
void Visit(Archive& a, BodySpec& v) {
  a(v.id, v.motion, v.shape, v.mass, v.position, v.orientation, v.velocity, v.angular_velocity, v.material, v.ccd,
    v.asleep, v.script);
}
template <class Archive>
void Visit(Archive& a, Area& v) {
  a(v.centre, v.radius, v.outward, v.fades);
}
template <class Archive>
void Visit(Archive& a, Rect& v) {
  a(v.min_x, v.max_x, v.min_z, v.max_z);
}
template <class Archive>
void Visit(Archive& a, LayoutChange& v) {
  a(v.epoch, v.regions, v.ranks, v.members);
}
template <class Archive>
void Visit(Archive& a, Input& v) {
  a(v.tick, v.source, v.sequence, v.kind, v.body, v.area, v.linear, v.angular, v.frame, v.point, v.ticks, v.again,
    v.spawn, v.layout);
}

namespace archive_internal {
template <class T>
concept Plain = std::is_arithmetic_v<T> || std::is_enum_v<T>;
template <class T, class Archive>
concept Member = requires(T& v, Archive& a) {
  v.Visit(a);
};
}  // namespace archive_internal

class Writer {
 public:
  // Appends.
  explicit Writer(std::string* out) : out_(out) {}

  template <class... T>
  void operator()(const T&... v) {
    (Put(v), ...);
  }
  // As the std::string to which `append` appends what it has; without making one.
  template <class Append>
  void Bytes(const Append& append) {
    const size_t at = out_->size();
    Put(size_t{0});
    append(out_);
    const size_t size = out_->size() - at - sizeof(size_t);
    std::memcpy(out_->data() + at, &size, sizeof size);
  }

 private:
  template <archive_internal::Plain T>
  void Put(const T& v) {
    out_->append(reinterpret_cast<const char*>(&v), sizeof v);
  }
  void Put(const std::string& v) {
    Put(v.size());
    out_->append(v);
  }
  void Put(const Vec3& v) { out_->append(reinterpret_cast<const char*>(v.data()), 3 * sizeof(double)); }
  void Put(const Quat& v) { out_->append(reinterpret_cast<const char*>(v.coeffs().data()), 4 * sizeof(double)); }
  template <class T, size_t n>
  void Put(const T (&v)[n]) {
    for (const T& x : v) Put(x);
  }
  template <class T, size_t n>
  void Put(const std::array<T, n>& v) {
    for (const T& x : v) Put(x);
  }
  template <class A, class B>
  void Put(const std::pair<A, B>& v) {
    Put(v.first);
    Put(v.second);
  }
  template <class T>
  void Put(const std::shared_ptr<T>& v) {
    Put(v != nullptr);
    if (v != nullptr) Put(*v);
  }
  template <class T>
  void Put(const std::vector<T>& v) {
    PutAll(v);
  }
  template <class T>
  void Put(const std::deque<T>& v) {
    PutAll(v);
  }
  template <class T>
  void Put(const std::set<T>& v) {
    PutAll(v);
  }
  template <class K, class V>
  void Put(const std::map<K, V>& v) {
    PutAll(v);
  }
  template <class K, class V>
  void Put(const std::multimap<K, V>& v) {
    PutAll(v);
  }
  // Ascending, so that equal maps are equal bytes.
  template <class K, class V>
  void Put(const absl::flat_hash_map<K, V>& v) {
    std::vector<const std::pair<const K, V>*> sorted;
    sorted.reserve(v.size());
    for (const auto& x : v) sorted.push_back(&x);
    std::sort(sorted.begin(), sorted.end(), [](const auto* x, const auto* y) { return x->first < y->first; });
    Put(v.size());
    for (const auto* x : sorted) Put(*x);
  }
  template <class T>
  requires archive_internal::Member<T, Writer>
  void Put(const T& v) {
    const_cast<T&>(v).Visit(*this);  // one description for both ways; this way nothing is changed
  }
  template <class T>
  requires(std::is_class_v<T> && !archive_internal::Member<T, Writer>) void Put(const T& v) {
    Visit(*this, const_cast<T&>(v));
  }

  template <class C>
  void PutAll(const C& v) {
    Put(v.size());
    for (const auto& x : v) Put(x);
  }

  std::string* const out_;
};

// After the first thing that is not there, everything is read as zero or empty, and ok() is false.
class Reader {
 public:
  explicit Reader(std::string_view bytes) : left_(bytes) {}

  bool ok() const { return ok_; }
  // All was read, and nothing is left over.
  bool done() const { return ok_ && left_.empty(); }

  template <class... T>
  void operator()(T&... v) {
    (Get(v), ...);
  }

 private:
  bool Take(void* to, size_t bytes) {
    if (!ok_ || bytes > left_.size()) {
      ok_ = false;
      return false;
    }
    std::memcpy(to, left_.data(), bytes);
    left_.remove_prefix(bytes);
    return true;
  }
  // Elements take a byte at least, so damaged bytes cannot ask for more memory than that.
  size_t Count() {
    size_t n = 0;
    Get(n);
    if (n > left_.size()) ok_ = false;
    return ok_ ? n : 0;
  }

  template <archive_internal::Plain T>
  void Get(T& v) {
    if (!Take(&v, sizeof v)) v = T{};
  }
  void Get(bool& v) {
    uint8_t byte = 0;
    v = Take(&byte, 1) && byte != 0;
  }
  void Get(std::string& v) {
    v.resize(Count());
    Take(v.data(), v.size());
  }
  void Get(Vec3& v) {
    if (!Take(v.data(), 3 * sizeof(double))) v = Vec3::Zero();
  }
  void Get(Quat& v) {
    if (!Take(v.coeffs().data(), 4 * sizeof(double))) v = Quat::Identity();
  }
  template <class T, size_t n>
  void Get(T (&v)[n]) {
    for (T& x : v) Get(x);
  }
  template <class T, size_t n>
  void Get(std::array<T, n>& v) {
    for (T& x : v) Get(x);
  }
  template <class A, class B>
  void Get(std::pair<A, B>& v) {
    Get(v.first);
    Get(v.second);
  }
  template <class T>
  void Get(std::shared_ptr<T>& v) {
    bool there = false;
    Get(there);
    if (!there) return v.reset();
    auto value = std::make_shared<std::remove_const_t<T>>();
    if (++depth_ > kMostDepth) ok_ = false;
    if (ok_) Get(*value);
    --depth_;
    v = std::move(value);
  }
  template <class T>
  void Get(std::vector<T>& v) {
    GetAll(v);
  }
  template <class T>
  void Get(std::deque<T>& v) {
    GetAll(v);
  }
  template <class C>
  void GetAll(C& v) {
    v.clear();
    for (size_t n = Count(); ok_ && n > 0; --n) Get(v.emplace_back());
  }
  template <class T>
  void Get(std::set<T>& v) {
    v.clear();
    for (size_t n = Count(); ok_ && n > 0; --n) {
      T x{};
      Get(x);
      v.insert(v.end(), std::move(x));
    }
  }
  template <class K, class V>
  void Get(std::map<K, V>& v) {
    GetMap(v);
  }
  template <class K, class V>
  void Get(std::multimap<K, V>& v) {
    GetMap(v);
  }
  template <class K, class V>
  void Get(absl::flat_hash_map<K, V>& v) {
    GetMap(v);
  }
  template <class C>
  void GetMap(C& v) {
    v.clear();
    for (size_t n = Count(); ok_ && n > 0; --n) {
      std::pair<typename C::key_type, typename C::mapped_type> x{};
      Get(x);
      v.insert(v.end(), std::move(x));
    }
  }
  template <class T>
  requires archive_internal::Member<T, Reader>
  void Get(T& v) { v.Visit(*this); }
  template <class T>
  requires(std::is_class_v<T> && !archive_internal::Member<T, Reader>) void Get(T& v) { Visit(*this, v); }

  static constexpr int kMostDepth = 16;  // of what points to its own kind

  std::string_view left_;
  bool ok_ = true;
  int depth_ = 0;
};

}  // namespace aureole
