#include "server/control/run_event.h"

#include <gtest/gtest.h>

namespace aureole {
namespace {

TEST(RunEvents, AreNamedByTheirKind) {
  EXPECT_EQ(NameOf(v1::ControlEvent::REGION_ENDED), "RegionEnded");
  EXPECT_EQ(NameOf(v1::ControlEvent::LAYOUT_IN_FORCE), "LayoutInForce");
  EXPECT_EQ(NameOf(v1::ControlEvent::UNKNOWN), "Unknown");
}

TEST(RunEvents, WarnOfWhatIsLostAndNotOfItsReturn) {
  EXPECT_TRUE(IsWarning(v1::ControlEvent::REGION_REPLACED));
  EXPECT_TRUE(IsWarning(v1::ControlEvent::STORAGE_FAILED));
  EXPECT_FALSE(IsWarning(v1::ControlEvent::STORAGE_RECOVERED));
  EXPECT_TRUE(IsWarning(v1::ControlEvent::COPY_LOST));
  EXPECT_FALSE(IsWarning(v1::ControlEvent::COPY_RECOVERED));
  EXPECT_FALSE(IsWarning(v1::ControlEvent::REGION_STARTED));
  EXPECT_FALSE(IsWarning(v1::ControlEvent::LAYOUT_IN_FORCE));
}

}  // namespace
}  // namespace aureole
