#include "client/cli/mcap_reader.h"

#include <fstream>
#include <map>
#include <vector>

#include <absl/strings/str_cat.h>

#include "client/cli/mcap_format.h"

namespace aureole {
namespace {

// Little-endian fields of one record. After a read past the end, ok() is false and values are 0.
class Fields {
 public:
  explicit Fields(std::string_view bytes) : left_(bytes) {}

  template <class T>
  T Number() {
    const std::string_view bytes = Take(sizeof(T));
    uint64_t value = 0;
    for (size_t i = 0; i < bytes.size(); ++i) value |= uint64_t{static_cast<uint8_t>(bytes[i])} << 8 * i;
    return static_cast<T>(value);
  }
  std::string_view String() { return Take(Number<uint32_t>()); }
  std::string_view Take(uint64_t n) {
    if (n > left_.size()) {
      ok_ = false;
      left_ = {};
      return {};
    }
    const std::string_view out = left_.substr(0, n);
    left_.remove_prefix(n);
    return out;
  }
  std::string_view rest() const { return left_; }
  bool ok() const { return ok_; }

 private:
  std::string_view left_;
  bool ok_ = true;
};

class Reader {
 public:
  explicit Reader(const std::function<absl::Status(const McapMessage&)>& take) : take_(take) {}

  absl::Status Take(uint8_t opcode, std::string_view content) {
    Fields f(content);
    switch (opcode) {
      case mcap::kSchema: {
        const auto id = f.Number<uint16_t>();
        schemas_[id] = f.String();
        break;
      }
      case mcap::kChannel: {
        const auto id = f.Number<uint16_t>();
        const auto schema = f.Number<uint16_t>();
        channels_[id] = {schema, std::string(f.String())};
        break;
      }
      case mcap::kMessage:
        return TakeMessage(&f);
      case mcap::kChunk:
        return TakeChunk(&f);
      default:
        break;
    }
    return f.ok() ? absl::OkStatus() : absl::InvalidArgumentError("a record is too short");
  }

 private:
  absl::Status TakeMessage(Fields* f) {
    const auto channel = channels_.find(f->Number<uint16_t>());
    f->Number<uint32_t>();
    McapMessage message;
    message.time_ns = f->Number<uint64_t>();
    f->Number<uint64_t>();
    if (!f->ok() || channel == channels_.end()) return absl::InvalidArgumentError("a message without a channel");
    message.topic = channel->second.second;
    message.type = schemas_[channel->second.first];
    message.data = f->rest();
    return take_(message);
  }

  absl::Status TakeChunk(Fields* f) {
    f->Take(8 + 8 + 8 + 4);
    if (!f->String().empty()) return absl::InvalidArgumentError("its chunks are compressed; only plain ones are read");
    Fields records(f->Take(f->Number<uint64_t>()));
    while (f->ok() && !records.rest().empty()) {
      const auto opcode = records.Number<uint8_t>();
      const std::string_view content = records.Take(records.Number<uint64_t>());
      if (!records.ok()) break;
      if (opcode == mcap::kChunk) return absl::InvalidArgumentError("a chunk within a chunk");
      if (absl::Status s = Take(opcode, content); !s.ok()) return s;
    }
    return f->ok() && records.ok() ? absl::OkStatus() : absl::InvalidArgumentError("a chunk is too short");
  }

  const std::function<absl::Status(const McapMessage&)>& take_;
  std::map<uint16_t, std::string> schemas_;
  std::map<uint16_t, std::pair<uint16_t, std::string>> channels_;
};

}  // namespace

absl::Status ReadMcap(const std::string& path, const std::function<absl::Status(const McapMessage&)>& take,
                      bool* whole) {
  *whole = false;
  std::ifstream in(path, std::ios::binary);
  if (!in) return absl::NotFoundError(absl::StrCat(path, ": cannot be opened"));
  in.seekg(0, std::ios::end);
  const auto size = static_cast<uint64_t>(in.tellg());
  in.seekg(0);
  std::string bytes(mcap::kMagic.size(), '\0');
  in.read(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  if (!in || bytes != mcap::kMagic) return absl::InvalidArgumentError(absl::StrCat(path, ": is no MCAP file"));
  Reader reader(take);
  while (true) {
    const auto at = static_cast<uint64_t>(in.tellg());
    char head[9];
    in.read(head, sizeof(head));
    if (!in) return absl::OkStatus();
    Fields f(std::string_view(head, sizeof(head)));
    const auto opcode = f.Number<uint8_t>();
    const auto length = f.Number<uint64_t>();
    if (length > size - at) return absl::OkStatus();  // cut off
    bytes.resize(length);
    in.read(bytes.data(), static_cast<std::streamsize>(length));
    if (!in) return absl::OkStatus();
    if (opcode == mcap::kDataEnd) {
      *whole = true;
      return absl::OkStatus();
    }
    if (absl::Status s = reader.Take(opcode, bytes); !s.ok()) {
      return absl::Status(s.code(), absl::StrCat(path, ": byte ", at, ": ", std::string(s.message())));
    }
  }
}

}  // namespace aureole
