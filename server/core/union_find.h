// Disjoint sets over 0..n-1. The representative of a set is its smallest member, so it does not depend on the order of
// the unions.
#pragma once

#include <cstdint>
#include <vector>

namespace aureole {

class UnionFind {
 public:
  explicit UnionFind(int n = 0) { Reset(n); }
  void Reset(int n) {
    parent_.resize(n);
    for (int i = 0; i < n; ++i) parent_[i] = i;
  }
  int Add() {
    parent_.push_back(static_cast<int>(parent_.size()));
    return parent_.back();
  }
  int Find(int a) {
    while (parent_[a] != a) a = parent_[a] = parent_[parent_[a]];
    return a;
  }
  void Unite(int a, int b) {
    a = Find(a);
    b = Find(b);
    if (a < b) {
      parent_[b] = a;
    } else {
      parent_[a] = b;
    }
  }
  int size() const { return static_cast<int>(parent_.size()); }

 private:
  std::vector<int> parent_;
};

}  // namespace aureole
