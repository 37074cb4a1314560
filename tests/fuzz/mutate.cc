#include "tests/fuzz/mutate.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace aureole::fuzz {
namespace {

using google::protobuf::FieldDescriptor;
using google::protobuf::Message;
using google::protobuf::Reflection;

constexpr int kMostRepeated = 8;

double AnyDouble(sim::Random* random) {
  constexpr double kInf = std::numeric_limits<double>::infinity();
  constexpr double kSpecial[] = {0,
                                 -0.0,
                                 1,
                                 -1,
                                 0.5,
                                 1e-3,
                                 1e3,
                                 1e6,
                                 -1e6,
                                 1e12,
                                 1e15,
                                 1e300,
                                 -1e300,
                                 5e-324,
                                 kInf,
                                 -kInf,
                                 std::numeric_limits<double>::quiet_NaN()};
  if (random->Chance(0.4)) return random->In(-100, 100);
  return kSpecial[random->Below(static_cast<int>(std::size(kSpecial)))];
}

uint64_t AnyInteger(sim::Random* random) {
  constexpr uint64_t kSpecial[] = {
      0,           1, 2, 3, 5, 127, 128, 255, 1024, 1025, 65535, 1u << 31, ~0u, uint64_t{1} << 61, uint64_t{1} << 63,
      ~uint64_t{0}};
  if (random->Chance(0.3)) return random->Next() >> random->Below(64);
  return kSpecial[random->Below(static_cast<int>(std::size(kSpecial)))];
}

void SetAny(Message* m, const FieldDescriptor* f, sim::Random* random) {
  const Reflection* r = m->GetReflection();
  const bool add = f->is_repeated();
  const uint64_t n = AnyInteger(random);
  switch (f->cpp_type()) {
    case FieldDescriptor::CPPTYPE_INT32:
      return add ? r->AddInt32(m, f, static_cast<int32_t>(n)) : r->SetInt32(m, f, static_cast<int32_t>(n));
    case FieldDescriptor::CPPTYPE_INT64:
      return add ? r->AddInt64(m, f, static_cast<int64_t>(n)) : r->SetInt64(m, f, static_cast<int64_t>(n));
    case FieldDescriptor::CPPTYPE_UINT32:
      return add ? r->AddUInt32(m, f, static_cast<uint32_t>(n)) : r->SetUInt32(m, f, static_cast<uint32_t>(n));
    case FieldDescriptor::CPPTYPE_UINT64:
      return add ? r->AddUInt64(m, f, n) : r->SetUInt64(m, f, n);
    case FieldDescriptor::CPPTYPE_DOUBLE:
      return add ? r->AddDouble(m, f, AnyDouble(random)) : r->SetDouble(m, f, AnyDouble(random));
    case FieldDescriptor::CPPTYPE_FLOAT: {
      const auto value = static_cast<float>(std::clamp(AnyDouble(random), -3e38, 3e38));
      return add ? r->AddFloat(m, f, value) : r->SetFloat(m, f, value);
    }
    case FieldDescriptor::CPPTYPE_BOOL:
      return add ? r->AddBool(m, f, n % 2 == 1) : r->SetBool(m, f, n % 2 == 1);
    case FieldDescriptor::CPPTYPE_ENUM: {
      const int value = static_cast<int>(n % 16);
      return add ? r->AddEnumValue(m, f, value) : r->SetEnumValue(m, f, value);
    }
    case FieldDescriptor::CPPTYPE_STRING: {
      std::string text(static_cast<size_t>(random->Below(20)), 'a');
      for (char& c : text) c = static_cast<char>('a' + random->Below(26));
      return add ? r->AddString(m, f, text) : r->SetString(m, f, text);
    }
    case FieldDescriptor::CPPTYPE_MESSAGE: {
      Message* child = add ? r->AddMessage(m, f) : r->MutableMessage(m, f);
      for (int i = random->Below(3); i > 0; --i) Mutate(child, random);
      return;
    }
  }
}

void MutateRepeated(Message* m, const FieldDescriptor* f, sim::Random* random) {
  const Reflection* r = m->GetReflection();
  const int size = r->FieldSize(*m, f);
  if (size > 0 && random->Chance(0.5)) {
    if (f->cpp_type() == FieldDescriptor::CPPTYPE_MESSAGE && random->Chance(0.8)) {
      Mutate(r->MutableRepeatedMessage(m, f, random->Below(size)), random);
    } else if (random->Chance(0.5)) {
      r->SwapElements(m, f, random->Below(size), random->Below(size));
    } else {
      r->RemoveLast(m, f);
    }
  } else if (size < kMostRepeated) {
    SetAny(m, f, random);
  }
}

}  // namespace

void Mutate(Message* message, sim::Random* random) {
  const google::protobuf::Descriptor* type = message->GetDescriptor();
  if (type->field_count() == 0) return;
  const FieldDescriptor* f = type->field(random->Below(type->field_count()));
  const Reflection* r = message->GetReflection();
  if (f->is_repeated()) return MutateRepeated(message, f, random);
  const bool message_field = f->cpp_type() == FieldDescriptor::CPPTYPE_MESSAGE;
  if (message_field && r->HasField(*message, f) && random->Chance(0.8)) {
    return Mutate(r->MutableMessage(message, f), random);
  }
  random->Chance(0.15) ? r->ClearField(message, f) : SetAny(message, f, random);
}

void Mutate(std::string* bytes, sim::Random* random) {
  for (int i = 1 + random->Below(4); i > 0 && !bytes->empty(); --i) {
    const auto at = static_cast<size_t>(random->Next() % bytes->size());
    switch (random->Below(5)) {
      case 0:
        (*bytes)[at] = static_cast<char>(random->Next());
        break;
      case 1:
        (*bytes)[at] = static_cast<char>((*bytes)[at] ^ (1 << random->Below(8)));
        break;
      case 2:
        bytes->resize(at);
        break;
      case 3:
        bytes->insert(at, bytes->substr(at, 1 + static_cast<size_t>(random->Below(16))));
        break;
      default:
        bytes->erase(at, 1 + static_cast<size_t>(random->Below(8)));
    }
  }
}

}  // namespace aureole::fuzz
