// A certificate authority with one server, 127.0.0.1, and one client; made anew each time.
#pragma once

#include <httplib.h>

#include <memory>
#include <string>

namespace aureole::kubernetes {

struct TlsKeys {
  std::string ca;  // all PEM
  std::string server_certificate, server_key;
  std::string client_certificate, client_key;

  // Refuses clients without a certificate of the authority.
  std::unique_ptr<httplib::Server> NewServer() const;
};

// `address`: what the server's certificate is for. `authority`: its name.
TlsKeys MakeTlsKeys(const std::string& address = "127.0.0.1", const std::string& authority = "authority");

}  // namespace aureole::kubernetes
