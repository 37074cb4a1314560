// Which bodies are close: two trees of fat boxes, and the pairs whose fat boxes overlap. A body that stays inside its
// fat box, or does not move, costs nothing.
#pragma once

#include <BulletCollision/BroadphaseCollision/btDbvt.h>

#include <deque>
#include <functional>
#include <vector>

#include "server/physics/body.h"

namespace aureole::physics {

class Broadphase {
 public:
  // `release` frees what a pair holds before the pair goes.
  explicit Broadphase(std::function<void(Pair&)> release) : release_(std::move(release)) {}

  // Adds the body with its exact box, and its pairs.
  void Insert(Body* body);
  // Removes the body and its pairs.
  void Remove(Body* body);
  // The body's exact box has changed; `motion` (m) is how far it is likely to go soon. Takes effect in Commit, after
  // the boxes of all bodies that move together have changed: a pair that only seems to part in between must live on.
  void Update(Body* body, const btVector3& motion);
  void Commit();
  // Keeps the trees shallow; once a tick.
  void Rebalance();

  // Calls fn(Body*) for every dynamic body whose exact box meets the box, in no particular order. In a large world
  // nodes and bodies are far from the processor, so they are asked for before they are needed. `fn` must not query.
  template <class Fn>
  void Query(const btVector3& low, const btVector3& high, Fn&& fn) const {
    if (moving_.m_root == nullptr) return;
    const btDbvtVolume box = btDbvtVolume::FromMM(low, high);
    std::vector<const btDbvtNode*>& open = open_nodes_;
    std::vector<Body*>& found = found_bodies_;
    open.assign(1, moving_.m_root);
    found.clear();
    while (!open.empty()) {
      const btDbvtNode* node = open.back();
      open.pop_back();
      if (!Intersect(node->volume, box)) continue;
      if (node->isinternal()) {
        for (const btDbvtNode* child : {node->childs[0], node->childs[1]}) {
          __builtin_prefetch(child);
          __builtin_prefetch(reinterpret_cast<const char*>(child) + sizeof(*child) - 1);
          open.push_back(child);
        }
      } else {
        found.push_back(static_cast<Body*>(node->data));
        __builtin_prefetch(&found.back()->id);
        __builtin_prefetch(&found.back()->low);
        __builtin_prefetch(&found.back()->high);
      }
    }
    for (Body* b : found) {
      if (b->low.x() <= high.x() && low.x() <= b->high.x() && b->low.y() <= high.y() && low.y() <= b->high.y() &&
          b->low.z() <= high.z() && low.z() <= b->high.z()) {
        fn(b);
      }
    }
  }

  // Calls fn(Body*) for every body, fixed ones too, whose fat box meets the line, in no particular order.
  template <class Fn>
  void ForEachOnRay(const btVector3& begin, const btVector3& end, Fn&& fn) const {
    struct Hits : btDbvt::ICollide {
      explicit Hits(Fn& f) : call(f) {}
      void Process(const btDbvtNode* leaf) override { call(static_cast<Body*>(leaf->data)); }
      Fn& call;
    } hits(fn);
    for (const btDbvt* tree : {const_cast<const btDbvt*>(&moving_), &fixed_})
      btDbvt::rayTest(tree->m_root, begin, end, hits);
  }

 private:
  void FindPairs(Body* body);
  void AddPair(Body* x, Body* y);
  void RemovePair(Pair* pair);

  std::function<void(Pair&)> release_;
  mutable btDbvt moving_;  // dynamic bodies
  btDbvt fixed_;           // static and kinematic ones
  std::deque<Pair> pool_;
  std::vector<Pair*> free_;
  std::vector<Body*> moved_, close_;
  mutable std::vector<const btDbvtNode*> open_nodes_;  // of Query
  mutable std::vector<Body*> found_bodies_;            // likewise
};

}  // namespace aureole::physics
