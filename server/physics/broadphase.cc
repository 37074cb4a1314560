#include "server/physics/broadphase.h"

namespace aureole::physics {
namespace {

constexpr double kFat = 0.05;  // m around the exact box

void Unlink(std::vector<Pair*>* list, size_t index, Body* owner) {
  Pair* last = list->back();
  (*list)[index] = last;
  (last->a == owner ? last->index_a : last->index_b) = index;
  list->pop_back();
}

}  // namespace

void Broadphase::Insert(Body* body) {
  btDbvtVolume volume = btDbvtVolume::FromMM(body->low, body->high);
  volume.Expand(btVector3(kFat, kFat, kFat));
  body->leaf = (body->dynamic() ? moving_ : fixed_).insert(volume, body);
  FindPairs(body);
}

void Broadphase::Remove(Body* body) {
  while (!body->pairs.empty()) RemovePair(body->pairs.back());
  (body->dynamic() ? moving_ : fixed_).remove(body->leaf);
  body->leaf = nullptr;
}

void Broadphase::Update(Body* body, const btVector3& motion) {
  btDbvtVolume volume = btDbvtVolume::FromMM(body->low, body->high);
  if ((body->dynamic() ? moving_ : fixed_).update(body->leaf, volume, motion, kFat)) moved_.push_back(body);
}

void Broadphase::Commit() {
  for (Body* body : moved_) {
    for (size_t i = body->pairs.size(); i-- > 0;) {
      Pair* p = body->pairs[i];
      if (!Intersect(body->leaf->volume, p->Other(body)->leaf->volume)) RemovePair(p);
    }
  }
  for (Body* body : moved_) FindPairs(body);
  moved_.clear();
}

void Broadphase::Rebalance() { moving_.optimizeIncremental(1 + moving_.m_leaves / 200); }

void Broadphase::FindPairs(Body* body) {
  struct Close : btDbvt::ICollide {
    explicit Close(std::vector<Body*>* to) : out(to) {}
    void Process(const btDbvtNode* leaf) override { out->push_back(static_cast<Body*>(leaf->data)); }
    std::vector<Body*>* out;
  } close(&close_);
  close_.clear();
  moving_.collideTV(moving_.m_root, body->leaf->volume, close);
  if (body->dynamic()) fixed_.collideTV(fixed_.m_root, body->leaf->volume, close);
  for (Body* other : close_) {
    if (other == body) continue;
    // Dynamic bodies have few pairs, a large kinematic one may have many.
    const Body* few = body->pairs.size() <= other->pairs.size() ? body : other;
    const Body* many = few == body ? other : body;
    bool known = false;
    for (const Pair* p : few->pairs) known = known || p->Other(few) == many;
    if (!known) AddPair(body, other);
  }
}

void Broadphase::AddPair(Body* x, Body* y) {
  if (free_.empty()) {
    pool_.emplace_back();
    free_.push_back(&pool_.back());
  }
  Pair* p = free_.back();
  free_.pop_back();
  p->a = x->id < y->id ? x : y;
  p->b = x->id < y->id ? y : x;
  p->index_a = p->a->pairs.size();
  p->a->pairs.push_back(p);
  p->index_b = p->b->pairs.size();
  p->b->pairs.push_back(p);
}

void Broadphase::RemovePair(Pair* p) {
  release_(*p);
  Unlink(&p->a->pairs, p->index_a, p->a);
  Unlink(&p->b->pairs, p->index_b, p->b);
  free_.push_back(p);
}

}  // namespace aureole::physics
