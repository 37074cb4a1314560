#include "server/control/kubernetes/control_metrics.h"

#include <exception>
#include <utility>

#include <absl/strings/str_cat.h>
#include <prometheus/counter.h>
#include <prometheus/exposer.h>
#include <prometheus/gauge.h>
#include <prometheus/registry.h>

namespace aureole::kubernetes {

struct ControlMetrics::Impl {
  explicit Impl(const std::string& address) : exposer(address, 1), registry(std::make_shared<prometheus::Registry>()) {
    exposer.RegisterCollectable(registry);
  }
  prometheus::Gauge& Gauge(const char* name, const char* help) const {
    return prometheus::BuildGauge().Name(name).Help(help).Register(*registry).Add({});
  }
  prometheus::Counter& Counter(const char* name, const char* help) const {
    return prometheus::BuildCounter().Name(name).Help(help).Register(*registry).Add({});
  }
  static void Raise(prometheus::Counter* counter, int64_t total) {
    counter->Increment(static_cast<double>(total) - counter->Value());
  }

  prometheus::Exposer exposer;
  std::shared_ptr<prometheus::Registry> registry;
  prometheus::Gauge& leads = Gauge("aureole_control_leader", "1 while this control plane leads, else 0.");
  prometheus::Gauge& epoch = Gauge("aureole_control_epoch", "Of its time of leading; 0 while it does not.");
  prometheus::Gauge& worlds = Gauge("aureole_control_worlds", "Worlds that it takes care of.");
  prometheus::Counter& requests = Counter("aureole_control_api_requests_total", "Requests to the API server.");
  prometheus::Counter& repeated =
      Counter("aureole_control_api_repeated_total", "Of these, because the one before had failed.");
  prometheus::Counter& refused =
      Counter("aureole_control_api_refused_total", "Of these, refused as not valid, such as a status by the schema.");
};

ControlMetrics::ControlMetrics(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}

ControlMetrics::~ControlMetrics() = default;

absl::StatusOr<std::unique_ptr<ControlMetrics>> ControlMetrics::Serve(const std::string& address) {
  try {
    return std::unique_ptr<ControlMetrics>(new ControlMetrics(std::make_unique<Impl>(address)));
  } catch (const std::exception& e) {  // the library throws
    return absl::UnavailableError(absl::StrCat("--metrics: cannot listen on ", address, ": ", e.what()));
  }
}

int ControlMetrics::port() const { return impl_->exposer.GetListeningPorts().front(); }

void ControlMetrics::Update(int64_t epoch, size_t worlds, const ApiStats& api) {
  impl_->leads.Set(epoch > 0 ? 1 : 0);
  impl_->epoch.Set(static_cast<double>(epoch));
  impl_->worlds.Set(static_cast<double>(worlds));
  Impl::Raise(&impl_->requests, api.requests);
  Impl::Raise(&impl_->repeated, api.repeated);
  Impl::Raise(&impl_->refused, api.refused);
}

}  // namespace aureole::kubernetes
