#include "server/transport/cell_view.h"

#include <algorithm>
#include <cmath>

#include <Eigen/LU>

namespace aureole {
namespace {

constexpr int kMostSides = 8;
// The world's end, so that every view has bounds.
constexpr double kFar = 2 * limits::kCoordinate.max;

// Distance in x, z from a point to the cell.
double Distance(const Vec3& p, const CellKey& c) {
  const double x = c.x * kCellSize, z = c.z * kCellSize;
  const double dx = std::max({x - p.x(), 0.0, p.x() - x - kCellSize});
  const double dz = std::max({z - p.z(), 0.0, p.z() - z - kCellSize});
  return std::hypot(dx, dz);
}

}  // namespace

CellView::CellView(const Path& path, const v1::View& view, SpecCheck* check) {
  switch (view.shape_case()) {
    case v1::View::SHAPE_NOT_SET:
      return;
    case v1::View::kBox: {
      const Vec3 low = check->Position(path / "box" / "min", view.box().min());
      const Vec3 high = check->Position(path / "box" / "max", view.box().max());
      if (!(low.x() <= high.x()) || !(low.z() <= high.z())) check->Fail(path / "box" / "max", "must not be below min");
      AddRect(low.x(), high.x(), low.z(), high.z());
      break;
    }
    case v1::View::kSphere: {
      const Path sphere = path / "sphere";
      round_ = true;
      centre_ = check->Position(sphere / "centre", view.sphere().centre());
      radius_ = check->Positive({0, kFar, "m"}, sphere / "radius", view.sphere().radius());
      AddRect(centre_.x() - radius_, centre_.x() + radius_, centre_.z() - radius_, centre_.z() + radius_);
      break;
    }
    case v1::View::kFrustum:
      ReadFrustum(path, view, check);
      break;
  }
}

void CellView::AddRect(double min_x, double max_x, double min_z, double max_z) {
  planes_ = {{Vec3::UnitX(), min_x}, {-Vec3::UnitX(), -max_x}, {Vec3::UnitZ(), min_z}, {-Vec3::UnitZ(), -max_z}};
  min_x_ = min_x;
  max_x_ = max_x;
  min_z_ = min_z;
  max_z_ = max_z;
}

void CellView::ReadFrustum(const Path& path, const v1::View& view, SpecCheck* check) {
  const Path sides = path / "frustum" / "sides";
  const int n = view.frustum().sides_size();
  if (n == 0) check->Fail(sides, "must be at least one; leave the view out to see everything", v1::MISSING);
  if (n > kMostSides) check->Fail(sides, "must be at most 8", v1::TOO_MANY);
  min_y_ = check->In(limits::kCoordinate, path / "min_y", view.min_y());
  max_y_ = check->In(limits::kCoordinate, path / "max_y", view.max_y());
  if (min_y_ == 0 && max_y_ == 0) {
    min_y_ = -1000;
    max_y_ = 1000;
  }
  if (min_y_ > max_y_) check->Fail(path / "max_y", "must not be below min_y");
  for (int i = 0; i < n && check->ok(); ++i) {
    const auto& side = view.frustum().sides(i);
    const Vec3 normal = check->Vector({-1e9, 1e9, ""}, sides[i] / "normal", side.normal());
    if (normal.norm() < 1e-9) check->Fail(sides[i] / "normal", "must not be 0");
    planes_.push_back({normal, check->In({-1e15, 1e15, ""}, sides[i] / "offset", side.offset())});
  }
  if (check->ok()) FindBounds();
}

// The corners of the body that the sides, the heights and the world's end cut out: points where three of them meet and
// that are inside of all others.
void CellView::FindBounds() {
  std::vector<Plane> all = planes_;
  all.push_back({Vec3::UnitY(), min_y_});
  all.push_back({-Vec3::UnitY(), -max_y_});
  for (const Vec3& axis : {Vec3(Vec3::UnitX()), Vec3(Vec3::UnitZ())}) {
    all.push_back({axis, -kFar});
    all.push_back({-axis, -kFar});
  }
  for (Plane& p : all) {
    const double length = p.normal.norm();
    p.normal /= length;
    p.offset /= length;
  }
  min_x_ = min_z_ = kFar;
  max_x_ = max_z_ = -kFar;
  for (size_t i = 0; i < all.size(); ++i) {
    for (size_t j = i + 1; j < all.size(); ++j) {
      for (size_t k = j + 1; k < all.size(); ++k) {
        Eigen::Matrix3d m;
        m << all[i].normal.transpose(), all[j].normal.transpose(), all[k].normal.transpose();
        if (std::abs(m.determinant()) < 1e-12) continue;
        const Vec3 p = m.inverse() * Vec3(all[i].offset, all[j].offset, all[k].offset);
        const double slack = 1e-6 * (1 + p.norm());
        if (std::any_of(all.begin(), all.end(), [&](const Plane& q) { return q.normal.dot(p) < q.offset - slack; })) {
          continue;
        }
        min_x_ = std::min(min_x_, p.x() - slack);
        max_x_ = std::max(max_x_, p.x() + slack);
        min_z_ = std::min(min_z_, p.z() - slack);
        max_z_ = std::max(max_z_, p.z() + slack);
      }
    }
  }
}

bool CellView::Selects(const CellKey& c) const {
  if (everything()) return true;
  const Vec3 low(c.x * kCellSize, min_y_, c.z * kCellSize);
  const Vec3 high(low.x() + kCellSize, max_y_, low.z() + kCellSize);
  if (high.x() <= min_x_ || low.x() > max_x_ || high.z() <= min_z_ || low.z() > max_z_) return false;
  if (round_) return Distance(centre_, c) <= radius_;
  // Outside of one side altogether.
  return std::none_of(planes_.begin(), planes_.end(), [&](const Plane& p) {
    double most = 0;
    for (int i = 0; i < 3; ++i) most += p.normal[i] * (p.normal[i] > 0 ? high : low)[i];
    return most < p.offset;
  });
}

std::optional<std::vector<CellKey>> CellView::Cells(size_t most) const {
  if (everything()) return std::nullopt;
  std::vector<CellKey> out;
  if (min_x_ > max_x_ || min_z_ > max_z_) return out;
  const CellKey low = CellOf({min_x_, 0, min_z_}), high = CellOf({max_x_, 0, max_z_});
  const double columns = 1.0 + high.x - low.x, rows = 1.0 + high.z - low.z;
  if (columns * rows > 4.0 * static_cast<double>(most)) return std::nullopt;
  for (int32_t x = low.x; x <= high.x; ++x) {
    for (int32_t z = low.z; z <= high.z; ++z) {
      if (Selects({x, z})) out.push_back({x, z});
    }
  }
  if (out.size() > most) return std::nullopt;
  return out;
}

DetailLevels::DetailLevels(const Path& path, const v1::LevelOfDetail& detail, SpecCheck* check) {
  eye_ = check->Position(path / "eye", detail.eye());
  full_within_ = check->In({0, kFar, "m"}, path / "full_within", detail.full_within());
}

int DetailLevels::Every(const CellKey& cell) const {
  if (full()) return 1;
  const double far = Distance(eye_, cell) / full_within_;
  return far <= 1 ? 1 : far <= 2 ? 2 : far <= 4 ? 4 : 8;
}

}  // namespace aureole
