#include "server/transport/convex_hull.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace aureole {
namespace {

struct Face {
  Vec3 normal;  // outward, length 1
  double offset = 0;
};

struct Point2 {
  double u, v;
  friend bool operator<(const Point2& a, const Point2& b) { return a.u != b.u ? a.u < b.u : a.v < b.v; }
};
double Cross(const Point2& o, const Point2& a, const Point2& b) {
  return (a.u - o.u) * (b.v - o.v) - (a.v - o.v) * (b.u - o.u);
}

// Of the convex hull of the points on the face. Andrew's monotone chain, 1979: the fan of the lower chain and that of
// the upper one about the leftmost point, without angles.
double Area(const std::vector<Vec3>& points, const Face& face, double tolerance) {
  const Vec3 u = face.normal.unitOrthogonal(), v = face.normal.cross(u);
  std::vector<Point2> on;
  for (const Vec3& p : points) {
    if (std::abs(face.normal.dot(p) - face.offset) <= tolerance) on.push_back({u.dot(p), v.dot(p)});
  }
  std::sort(on.begin(), on.end());
  double twice = 0;
  for (const double side : {1.0, -1.0}) {
    std::vector<Point2> chain;
    for (const Point2& p : on) {
      while (chain.size() >= 2 && side * Cross(chain[chain.size() - 2], chain.back(), p) <= 0) chain.pop_back();
      chain.push_back(p);
    }
    for (size_t i = 1; i + 1 < chain.size(); ++i) twice += side * Cross(chain[0], chain[i], chain[i + 1]);
  }
  return twice / 2;
}

}  // namespace

HullMeasure MeasureHull(const std::vector<Vec3>& points) {
  if (points.size() < 4) return {};
  double extent = 0;
  for (const Vec3& p : points) extent = std::max(extent, (p - points[0]).cwiseAbs().maxCoeff());
  const double tolerance = 1e-9 * extent;
  // Every plane through three points that leaves all others on one side is a face. Planes of more than three points
  // are found more than once.
  std::vector<Face> faces;
  for (size_t i = 0; i < points.size(); ++i) {
    for (size_t j = 0; j < points.size(); ++j) {
      for (size_t k = j + 1; i < j && k < points.size(); ++k) {
        Vec3 normal = (points[j] - points[i]).cross(points[k] - points[i]);
        if (normal.norm() <= tolerance * extent) continue;
        normal.normalize();
        double below = 0, above = 0;
        for (const Vec3& p : points) {
          const double d = normal.dot(p - points[i]);
          below = std::min(below, d);
          above = std::max(above, d);
        }
        if (above > tolerance && below < -tolerance) continue;  // cuts through
        if (above <= tolerance && below >= -tolerance) return {};
        if (above > tolerance) normal = -normal;
        const Face face{normal, normal.dot(points[i])};
        const bool known = std::any_of(faces.begin(), faces.end(), [&](const Face& f) {
          return (f.normal - face.normal).norm() < 1e-6 && std::abs(f.offset - face.offset) < 1e-6 * extent;
        });
        if (!known) faces.push_back(face);
      }
    }
  }
  if (faces.empty()) return {};
  // A cone from the first point to each face.
  HullMeasure m;
  m.depth = std::numeric_limits<double>::infinity();
  for (const Face& face : faces) {
    m.volume += Area(points, face, 1e-6 * extent) * (face.offset - face.normal.dot(points[0])) / 3;
    m.depth = std::min(m.depth, face.offset);
  }
  return m;
}

}  // namespace aureole
