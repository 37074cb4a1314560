// The table of reasons that clients read is that of the interface.
#include <gtest/gtest.h>

#include <fstream>
#include <map>
#include <string>

#include "aureole/v1/error.pb.h"
#include "server/transport/error_status.h"

namespace aureole {
namespace {

// Reason to its code, as the table says.
std::map<std::string, std::string> Table() {
  std::ifstream file(AUREOLE_PROTO "/README.md");
  std::map<std::string, std::string> out;
  std::string line;
  while (std::getline(file, line)) {
    if (line.rfind("| `", 0) != 0) continue;
    const size_t name_end = line.find('`', 3), code = line.find("| ", name_end) + 2, code_end = line.find(" |", code);
    EXPECT_GT(line.size(), code_end + 20) << "what happened, and what to do: " << line;
    out[line.substr(3, name_end - 3)] = line.substr(code, code_end - code);
  }
  return out;
}

TEST(Reasons, TableHasEachOnceAndNoOther) {
  std::map<std::string, std::string> table = Table();
  const auto* reasons = v1::Reason_descriptor();
  for (int i = 0; i < reasons->value_count(); ++i) {
    const std::string& name = reasons->value(i)->name();
    EXPECT_EQ(table.erase(name), reasons->value(i)->number() == 0 ? 0u : 1u) << name;
  }
  EXPECT_TRUE(table.empty()) << table.begin()->first << " is no reason";
}

TEST(Reasons, RefusalSaysItInTheMessageAndInTheDetails) {
  const grpc::Status s = Refusal(grpc::StatusCode::INVALID_ARGUMENT, v1::TOO_MANY, "bodies", "must be at most 3");
  EXPECT_EQ(s.error_message(), "TOO_MANY bodies: must be at most 3");
  v1::ErrorStatus details;
  v1::ErrorDetail detail;
  ASSERT_TRUE(details.ParseFromString(s.error_details()));
  EXPECT_EQ(details.code(), 3);
  EXPECT_EQ(details.message(), s.error_message());
  ASSERT_TRUE(details.details(0).UnpackTo(&detail));
  EXPECT_EQ(detail.reason(), v1::TOO_MANY);
  EXPECT_EQ(detail.field(), "bodies");
  EXPECT_EQ(detail.remedy(), "must be at most 3");
  EXPECT_EQ(Table()["NO_REGION"], "UNAVAILABLE");
  EXPECT_EQ(NoRegion().error_code(), grpc::StatusCode::UNAVAILABLE);
}

}  // namespace
}  // namespace aureole
