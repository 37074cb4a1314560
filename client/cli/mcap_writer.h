// Writes MCAP files (mcap.dev/spec, version 0) of protobuf messages: chunks without compression, with indexes.
#pragma once

#include <cstdint>
#include <fstream>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include <absl/status/status.h>
#include <absl/status/statusor.h>
#include <google/protobuf/descriptor.h>

namespace aureole {

class McapWriter {
 public:
  // Creates or replaces the file.
  static absl::StatusOr<std::unique_ptr<McapWriter>> Open(const std::string& path);
  // Closes, and ignores errors.
  ~McapWriter();

  // `time_ns`: of the recording. All messages of a topic are of one type.
  absl::Status Write(const std::string& topic, const google::protobuf::Descriptor* type, uint64_t time_ns,
                     const std::string& message);
  // So that what was written can be read even if the file is never closed. Costs some bytes.
  absl::Status Flush() { return EndChunk(); }
  // Ends the file, with its summary.
  absl::Status Close();

  int64_t bytes() const { return offset_ + static_cast<int64_t>(chunk_.size()); }
  int64_t messages() const { return messages_; }

 private:
  struct Channel {
    uint16_t id = 0;
    std::string schema, record;  // records as they are in the file
    uint64_t messages = 0;
  };
  struct Chunk {
    uint64_t first = 0, last = 0;  // ns
    int64_t offset = 0, length = 0, index_length = 0, size = 0;
    std::map<uint16_t, uint64_t> indexes;
  };

  explicit McapWriter(const std::string& path) : path_(path), out_(path, std::ios::binary | std::ios::trunc) {}
  absl::Status Put(const std::string& bytes);
  absl::Status EndChunk();
  std::string Summary(int64_t* offsets) const;

  const std::string path_;
  std::ofstream out_;
  bool closed_ = false;
  int64_t offset_ = 0, messages_ = 0;
  std::map<std::string, Channel> channels_;  // by topic
  std::map<std::string, uint16_t> schemas_;  // by type
  std::string chunk_;
  uint64_t chunk_first_ = 0, chunk_last_ = 0;
  std::map<uint16_t, std::vector<std::pair<uint64_t, uint64_t>>> chunk_index_;  // time, offset
  std::vector<Chunk> chunks_;
};

}  // namespace aureole
