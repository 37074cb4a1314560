#include "server/transport/error_status.h"

#include <absl/strings/str_cat.h>

namespace aureole {

grpc::Status Refusal(grpc::StatusCode code, v1::Reason reason, const std::string& field, const std::string& remedy) {
  v1::ErrorDetail detail;
  detail.set_reason(reason);
  detail.set_field(field);
  detail.set_remedy(remedy);
  v1::ErrorStatus status;
  status.set_code(code);
  status.set_message(absl::StrCat(v1::Reason_Name(reason), field.empty() ? "" : " ", field, ": ", remedy));
  status.add_details()->PackFrom(detail);
  return {code, status.message(), status.SerializeAsString()};
}

grpc::Status Refusal(const SpecCheck& check) {
  return Refusal(grpc::StatusCode::INVALID_ARGUMENT, check.reason(), check.field(), check.what());
}

grpc::Status NoRegion() {
  return Refusal(grpc::StatusCode::UNAVAILABLE, v1::NO_REGION, "",
                 "this server has no region at present; ask another server, or try again");
}

grpc::Status RegionGivenUp() {
  return Refusal(grpc::StatusCode::UNAVAILABLE, v1::NO_REGION, "",
                 "this server gives up its region; ask another server, or try again");
}

}  // namespace aureole
