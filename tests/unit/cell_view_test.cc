// Which cells a view selects.
#include "server/transport/cell_view.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "server/transport/replica_capture.h"

namespace aureole {
namespace {

CellView Read(const v1::View& view) {
  SpecCheck check;
  CellView out(Path() / "view", view, &check);
  EXPECT_TRUE(check.ok()) << check.status();
  return out;
}

std::string Refused(const v1::View& view) {
  SpecCheck check;
  const CellView out(Path() / "view", view, &check);
  return check.field();
}

v1::View BoxView(double min_x, double max_x, double min_z, double max_z) {
  v1::View view;
  view.mutable_box()->mutable_min()->set_x(min_x);
  view.mutable_box()->mutable_min()->set_z(min_z);
  view.mutable_box()->mutable_max()->set_x(max_x);
  view.mutable_box()->mutable_max()->set_z(max_z);
  return view;
}

void AddSide(double x, double y, double z, double offset, v1::View* view) {
  auto* side = view->mutable_frustum()->add_sides();
  side->mutable_normal()->set_x(x);
  side->mutable_normal()->set_y(y);
  side->mutable_normal()->set_z(z);
  side->set_offset(offset);
}

TEST(CellView, WithoutShapeItSelectsEverything) {
  const CellView view = Read({});
  EXPECT_TRUE(view.everything());
  EXPECT_TRUE(view.Selects({-30000, 30000}));
  EXPECT_FALSE(view.Cells(1000000).has_value());
}

TEST(CellView, BoxSelectsTheCellsItTouches) {
  const CellView view = Read(BoxView(-1, 33, 5, 6));
  EXPECT_EQ(view.Cells(100), (std::vector<CellKey>{{-1, 0}, {0, 0}, {1, 0}}));
  EXPECT_FALSE(view.Cells(2).has_value()) << "more than were asked for";
  EXPECT_TRUE(view.Selects({1, 0}));
  EXPECT_FALSE(view.Selects({2, 0}));
  EXPECT_FALSE(view.Selects({0, 1}));
}

TEST(CellView, SphereDoesNotSelectTheCornersOfItsBox) {
  v1::View message;
  message.mutable_sphere()->mutable_centre()->set_x(16);
  message.mutable_sphere()->mutable_centre()->set_z(16);
  message.mutable_sphere()->set_radius(20);
  const CellView view = Read(message);
  EXPECT_EQ(view.Cells(100), (std::vector<CellKey>{{-1, 0}, {0, -1}, {0, 0}, {0, 1}, {1, 0}}));
}

// Everything that a camera's pyramid shows is selected, and little else.
TEST(CellView, FrustumSelectsWhatIsInFrontOfTheCamera) {
  v1::View message;
  const double tilt = 0.3;
  // At (0, 50, 0), looking along +x and down, 60 degrees wide and high, to 200 m.
  const Vec3 eye(0, 50, 0), ahead(std::cos(tilt), -std::sin(tilt), 0), right(0, 0, 1),
      up(std::sin(tilt), std::cos(tilt), 0);
  const auto side = [&](const Vec3& normal) { AddSide(normal.x(), normal.y(), normal.z(), normal.dot(eye), &message); };
  for (double sign : {-1.0, 1.0}) {
    side(0.5 * ahead + sign * std::sqrt(0.75) * right);
    side(0.5 * ahead + sign * std::sqrt(0.75) * up);
  }
  AddSide(-ahead.x(), -ahead.y(), -ahead.z(), -ahead.dot(eye) - 200, &message);
  message.set_min_y(0);
  message.set_max_y(20);
  const CellView view = Read(message);
  for (double x = -300; x < 300; x += 7) {
    for (double z = -300; z < 300; z += 7) {
      for (double y = 0; y <= 20; y += 5) {
        const Vec3 to = Vec3(x, y, z) - eye;
        const double depth = to.dot(ahead);
        const double wide = std::tan(3.14159265358979323846 / 6) * depth;
        const bool seen = depth > 0 && depth < 200 && std::abs(to.dot(right)) < wide && std::abs(to.dot(up)) < wide;
        if (seen) {
          ASSERT_TRUE(view.Selects(CellOf({x, y, z}))) << x << " " << y << " " << z;
        }
      }
    }
  }
  EXPECT_FALSE(view.Selects({-2, 0}));
  EXPECT_FALSE(view.Selects({1, 8}));
  EXPECT_FALSE(view.Selects({10, 0}));
  const auto cells = view.Cells(1000);
  ASSERT_TRUE(cells.has_value());
  EXPECT_LT(cells->size(), 80u);
  for (const CellKey& c : *cells) EXPECT_TRUE(view.Selects(c));
}

TEST(CellView, FrustumThatHoldsNothingSelectsNothing) {
  v1::View view;
  AddSide(1, 0, 0, 10, &view);
  AddSide(-1, 0, 0, 10, &view);
  EXPECT_EQ(Read(view).Cells(100), std::vector<CellKey>());
}

TEST(CellView, WhatCannotBeIsRefusedWithItsField) {
  EXPECT_EQ(Refused(BoxView(0, std::nan(""), 0, 1)), "view.box.max.x");
  EXPECT_EQ(Refused(BoxView(2, 1, 0, 1)), "view.box.max");
  v1::View view;
  view.mutable_sphere()->set_radius(-1);
  EXPECT_EQ(Refused(view), "view.sphere.radius");
  view.mutable_frustum();
  EXPECT_EQ(Refused(view), "view.frustum.sides");
  AddSide(0, 0, 0, 1, &view);
  EXPECT_EQ(Refused(view), "view.frustum.sides[0].normal");
  for (int i = 0; i < 9; ++i) AddSide(1, 0, 0, 1, &view);
  EXPECT_EQ(Refused(view), "view.frustum.sides");
}

TEST(CellView, RectanglesCoverTheCellsOnce) {
  const std::vector<CellKey> cells{{0, 0}, {1, 0}, {0, 1}, {1, 1}, {1, 2}, {-3, 1}};
  const std::vector<CellRect> rects = RectsOf(cells);
  EXPECT_LE(rects.size(), 3u);
  for (int x = -5; x < 5; ++x) {
    for (int z = -5; z < 5; ++z) {
      const CellKey c{x, z};
      const auto holds = std::count_if(rects.begin(), rects.end(), [&](const CellRect& r) { return r.Contains(c); });
      EXPECT_EQ(holds, std::count(cells.begin(), cells.end(), c)) << x << ' ' << z;
    }
  }
}

TEST(CellView, WhatIsBeyondTheLastCellIsInIt) {
  EXPECT_EQ(CellOf({1e12, 0, -1e12}), (CellKey{kLastCell, -kLastCell - 1}));
  EXPECT_EQ(CellOf({-1, 0, 32}), (CellKey{-1, 1}));
}

TEST(DetailLevels, CellsFurtherAwayComeLessOften) {
  v1::LevelOfDetail message;
  message.mutable_eye()->set_x(16);
  message.mutable_eye()->set_z(16);
  message.set_full_within(50);
  SpecCheck check;
  const DetailLevels detail(Path(), message, &check);
  EXPECT_EQ(detail.Every({0, 0}), 1);
  EXPECT_EQ(detail.Every({2, 0}), 1) << "48 m away";
  EXPECT_EQ(detail.Every({3, 0}), 2);
  EXPECT_EQ(detail.Every({-5, 0}), 4) << "144 m";
  EXPECT_EQ(detail.Every({0, 20}), 8);
  EXPECT_EQ(DetailLevels().Every({9999, 0}), 1);
}

}  // namespace
}  // namespace aureole
