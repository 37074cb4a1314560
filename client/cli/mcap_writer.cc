#include "client/cli/mcap_writer.h"

#include <algorithm>
#include <limits>
#include <set>

#include <absl/strings/str_cat.h>
#include <google/protobuf/descriptor.pb.h>

#include "client/cli/mcap_format.h"

namespace aureole {
namespace {

using mcap::Opcode;

constexpr size_t kChunkBytes = 1 << 20;

// Little-endian fields of one record.
class Record {
 public:
  template <class T>
  Record& Number(T value) {
    for (size_t i = 0; i < sizeof(T); ++i) out_ += static_cast<char>(static_cast<uint64_t>(value) >> 8 * i);
    return *this;
  }
  Record& String(std::string_view s) {
    Number(static_cast<uint32_t>(s.size()));
    out_ += s;
    return *this;
  }
  Record& Bytes(std::string_view s) {
    out_ += s;
    return *this;
  }
  const std::string& content() const { return out_; }
  std::string As(Opcode opcode) const {
    Record head;
    head.Number(static_cast<uint8_t>(opcode)).Number(static_cast<uint64_t>(out_.size()));
    return head.content() + out_;
  }

 private:
  std::string out_;
};

template <class Key, class Value>
std::string MapOf(const std::map<Key, Value>& map) {
  Record out;
  for (const auto& [key, value] : map) out.Number(key).Number(value);
  return out.content();
}

void AddFile(const google::protobuf::FileDescriptor* file, std::set<std::string>* seen,
             google::protobuf::FileDescriptorSet* out) {
  if (!seen->insert(file->name()).second) return;
  for (int i = 0; i < file->dependency_count(); ++i) AddFile(file->dependency(i), seen, out);
  file->CopyTo(out->add_file());
}

std::string SchemaRecord(uint16_t id, const google::protobuf::Descriptor* type) {
  google::protobuf::FileDescriptorSet files;
  std::set<std::string> seen;
  AddFile(type->file(), &seen, &files);
  return Record()
      .Number(id)
      .String(type->full_name())
      .String("protobuf")
      .String(files.SerializeAsString())
      .As(mcap::kSchema);
}

}  // namespace

absl::StatusOr<std::unique_ptr<McapWriter>> McapWriter::Open(const std::string& path) {
  std::unique_ptr<McapWriter> out(new McapWriter(path));
  const std::string head = Record().String("").String("aureole").As(mcap::kHeader);
  if (absl::Status s = out->Put(std::string(mcap::kMagic) + head); !s.ok()) return s;
  return out;
}

McapWriter::~McapWriter() { Close().IgnoreError(); }

absl::Status McapWriter::Write(const std::string& topic, const google::protobuf::Descriptor* type, uint64_t time_ns,
                               const std::string& message) {
  const auto [it, fresh] = channels_.try_emplace(topic);
  Channel& channel = it->second;
  if (fresh) {
    const auto [schema, first] = schemas_.try_emplace(type->full_name(), static_cast<uint16_t>(schemas_.size() + 1));
    if (first) channel.schema = SchemaRecord(schema->second, type);
    channel.id = static_cast<uint16_t>(channels_.size());
    channel.record = Record()
                         .Number(channel.id)
                         .Number(schema->second)
                         .String(topic)
                         .String("protobuf")
                         .Number(uint32_t{0})
                         .As(mcap::kChannel);
    chunk_ += channel.schema + channel.record;
  }
  std::vector<std::pair<uint64_t, uint64_t>>& index = chunk_index_[channel.id];
  index.emplace_back(time_ns, chunk_.size());
  const bool first_of_chunk = chunk_index_.size() == 1 && index.size() == 1;
  chunk_first_ = first_of_chunk ? time_ns : std::min(chunk_first_, time_ns);
  chunk_last_ = first_of_chunk ? time_ns : std::max(chunk_last_, time_ns);
  chunk_ += Record()
                .Number(channel.id)
                .Number(static_cast<uint32_t>(channel.messages++))
                .Number(time_ns)
                .Number(time_ns)
                .Bytes(message)
                .As(mcap::kMessage);
  ++messages_;
  return chunk_.size() < kChunkBytes ? absl::OkStatus() : EndChunk();
}

absl::Status McapWriter::EndChunk() {
  if (chunk_index_.empty()) return absl::OkStatus();
  Chunk& chunk = chunks_.emplace_back();
  chunk.first = chunk_first_;
  chunk.last = chunk_last_;
  chunk.offset = offset_;
  chunk.size = static_cast<int64_t>(chunk_.size());
  const std::string record = Record()
                                 .Number(chunk.first)
                                 .Number(chunk.last)
                                 .Number(static_cast<uint64_t>(chunk_.size()))
                                 .Number(uint32_t{0})  // no checksum
                                 .String("")           // nor compression
                                 .Number(static_cast<uint64_t>(chunk_.size()))
                                 .Bytes(chunk_)
                                 .As(mcap::kChunk);
  chunk.length = static_cast<int64_t>(record.size());
  std::string indexes;
  for (const auto& [channel, entries] : chunk_index_) {
    Record list;
    for (const auto& [time, at] : entries) list.Number(time).Number(at);
    chunk.indexes[channel] = static_cast<uint64_t>(offset_) + record.size() + indexes.size();
    indexes += Record().Number(channel).String(list.content()).As(mcap::kMessageIndex);
  }
  chunk.index_length = static_cast<int64_t>(indexes.size());
  chunk_.clear();
  chunk_index_.clear();
  if (absl::Status s = Put(record + indexes); !s.ok()) return s;
  out_.flush();
  return absl::OkStatus();
}

absl::Status McapWriter::Close() {
  if (std::exchange(closed_, true)) return absl::OkStatus();
  if (absl::Status s = EndChunk(); !s.ok()) return s;
  if (absl::Status s = Put(Record().Number(uint32_t{0}).As(mcap::kDataEnd)); !s.ok()) return s;
  const int64_t begin = offset_;
  int64_t offsets = 0;
  const std::string summary = Summary(&offsets);
  const std::string footer = Record()
                                 .Number(static_cast<uint64_t>(begin))
                                 .Number(static_cast<uint64_t>(begin + offsets))
                                 .Number(uint32_t{0})
                                 .As(mcap::kFooter);
  if (absl::Status s = Put(summary + footer + std::string(mcap::kMagic)); !s.ok()) return s;
  out_.close();
  return out_.fail() ? absl::UnavailableError(absl::StrCat(path_, ": cannot be closed")) : absl::OkStatus();
}

// Where all is, for readers that do not read from the front. `offsets`: where its own table of contents begins.
std::string McapWriter::Summary(int64_t* offsets) const {
  std::string schemas, channels, chunks;
  std::map<uint16_t, uint64_t> counts;
  for (const auto& [topic, channel] : channels_) {
    schemas += channel.schema;
    channels += channel.record;
    counts[channel.id] = channel.messages;
  }
  uint64_t first = chunks_.empty() ? 0 : std::numeric_limits<uint64_t>::max(), last = 0;
  for (const Chunk& c : chunks_) {
    first = std::min(first, c.first);
    last = std::max(last, c.last);
    chunks += Record()
                  .Number(c.first)
                  .Number(c.last)
                  .Number(static_cast<uint64_t>(c.offset))
                  .Number(static_cast<uint64_t>(c.length))
                  .String(MapOf(c.indexes))
                  .Number(static_cast<uint64_t>(c.index_length))
                  .String("")
                  .Number(static_cast<uint64_t>(c.size))
                  .Number(static_cast<uint64_t>(c.size))
                  .As(mcap::kChunkIndex);
  }
  const std::string statistics = Record()
                                     .Number(static_cast<uint64_t>(messages_))
                                     .Number(static_cast<uint16_t>(schemas_.size()))
                                     .Number(static_cast<uint32_t>(channels_.size()))
                                     .Number(uint32_t{0})
                                     .Number(uint32_t{0})
                                     .Number(static_cast<uint32_t>(chunks_.size()))
                                     .Number(first)
                                     .Number(last)
                                     .String(MapOf(counts))
                                     .As(mcap::kStatistics);
  std::string out, contents;
  using Group = std::pair<Opcode, const std::string*>;
  for (const auto& [opcode, group] : {Group(mcap::kSchema, &schemas), Group(mcap::kChannel, &channels),
                                      Group(mcap::kChunkIndex, &chunks), Group(mcap::kStatistics, &statistics)}) {
    if (group->empty()) continue;
    contents += Record()
                    .Number(static_cast<uint8_t>(opcode))
                    .Number(static_cast<uint64_t>(offset_) + out.size())
                    .Number(static_cast<uint64_t>(group->size()))
                    .As(mcap::kSummaryOffset);
    out += *group;
  }
  *offsets = static_cast<int64_t>(out.size());
  return out + contents;
}

absl::Status McapWriter::Put(const std::string& bytes) {
  out_.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  offset_ += static_cast<int64_t>(bytes.size());
  return out_.good() ? absl::OkStatus() : absl::UnavailableError(absl::StrCat(path_, ": cannot be written"));
}

}  // namespace aureole
