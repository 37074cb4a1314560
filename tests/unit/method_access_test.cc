// What a method wants of its caller is decided for each, in one table.
#include <gtest/gtest.h>

#include <google/protobuf/descriptor.h>

#include <filesystem>
#include <set>

#include "server/transport/guard.h"

namespace aureole {
namespace {

// Of all the interface's files that there are in the source.
std::set<std::string> MethodsOfTheInterface() {
  std::set<std::string> out;
  for (const auto& file : std::filesystem::directory_iterator(AUREOLE_PROTO "/aureole/v1")) {
    if (file.path().extension() != ".proto") continue;
    const auto* descriptor = google::protobuf::DescriptorPool::generated_pool()->FindFileByName(
        "aureole/v1/" + file.path().filename().string());
    if (descriptor == nullptr) {
      ADD_FAILURE() << file.path() << " is not in this program";
      continue;
    }
    for (int s = 0; s < descriptor->service_count(); ++s) {
      for (int m = 0; m < descriptor->service(s)->method_count(); ++m) {
        out.insert(descriptor->service(s)->method(m)->full_name());
      }
    }
  }
  return out;
}

TEST(MethodAccess, HasEveryMethodOfTheInterfaceAndNoOther) {
  std::set<std::string> table;
  for (const auto& [method, access] : MethodAccess()) table.insert(method);
  EXPECT_EQ(table, MethodsOfTheInterface());
  EXPECT_GE(table.size(), 13u);
}

TEST(MethodAccess, IsAServersOrNeedsOneRight) {
  for (const auto& [method, access] : MethodAccess()) {
    EXPECT_EQ(access.server, access.right == v1::Token::UNKNOWN) << method;
    bool servers = false;
    for (const char* service : {".Peer.", ".Copies.", ".Control."})
      servers |= method.find(service) != std::string::npos;
    EXPECT_EQ(access.server, servers) << method;
  }
}

TEST(Rights, AreThoseOfTheToken) {
  v1::Token token;
  token.add_rights(v1::Token::PUSH);
  EXPECT_TRUE(Rights(token).Has(v1::Token::PUSH));
  EXPECT_FALSE(Rights(token).Has(v1::Token::WATCH));
  EXPECT_TRUE(RightsOfCaller().Has(v1::Token::OPERATE)) << "no guard stands before this thread";
}

}  // namespace
}  // namespace aureole
