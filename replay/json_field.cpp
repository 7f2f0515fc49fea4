#include "replay/json_field.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "pipeline/types/rig.h"
#include "replay/durable_folder.h"

namespace booth {
namespace {

using Json = nlohmann::json;

/// Looks at the text's structure before any of it is kept: where it stops being JSON, and how deep it nests.
class StructureCheck final : public nlohmann::json_sax<Json> {
 public:
  bool null() override { return true; }
  bool boolean(bool) override { return true; }
  bool number_integer(number_integer_t) override { return true; }
  bool number_unsigned(number_unsigned_t) override { return true; }
  bool number_float(number_float_t, const string_t&) override { return true; }
  bool string(string_t&) override { return true; }
  bool binary(binary_t&) override { return true; }
  bool start_object(size_t) override { return enter(); }
  bool key(string_t&) override { return true; }
  bool end_object() override { return leave(); }
  bool start_array(size_t) override { return enter(); }
  bool end_array() override { return leave(); }
  bool parse_error(size_t position, const std::string&, const nlohmann::detail::exception&) override {
    position_ = position;
    return false;
  }

  bool too_deep() const { return too_deep_; }
  size_t position() const { return position_; }  ///< of the fault, bytes

 private:
  bool enter() {
    constexpr int deepest = 32;
    too_deep_ = ++depth_ > deepest;
    return !too_deep_;
  }
  bool leave() {
    --depth_;
    return true;
  }

  int depth_ = 0;
  bool too_deep_ = false;
  size_t position_ = 0;
};

std::string place(std::span<const uint8_t> text, size_t position) {
  const auto before = text.first(std::min(position, text.size()));
  const auto line = std::count(before.begin(), before.end(), '\n') + 1;
  const auto last_break = std::find(before.rbegin(), before.rend(), '\n');
  return "line " + std::to_string(line) + ", column " + std::to_string(last_break - before.rbegin());
}

/// A value as a message quotes it: one short line.
std::string quoted(const Json& json) {
  if (json.is_object()) return "an object";
  if (json.is_array()) return "an array of " + std::to_string(json.size());
  constexpr size_t longest = 60;
  std::string text = json.dump(-1, ' ', true, Json::error_handler_t::replace);
  if (text.size() > longest) text = text.substr(0, longest) + "…";
  return text;
}

bool is_control(unsigned char c) { return c < 0x20 || c == 0x7f; }

std::string decimal(double number) { return Json(number).dump(); }

}  // namespace

Result<JsonDocument> JsonDocument::parse(std::string name, std::span<const uint8_t> text) {
  StructureCheck structure;
  if (!Json::sax_parse(text.begin(), text.end(), &structure)) {
    const std::string what =
        structure.too_deep() ? ": nests too deeply" : ": " + place(text, structure.position()) + ": is not JSON";
    return Error{ErrorCode::invalid_file, name + what};
  }
  JsonDocument document;
  document.name_ = std::move(name);
  constexpr bool throwing = false;
  document.root_ = Json::parse(text.begin(), text.end(), nullptr, throwing);
  return document;
}

void JsonDocument::report(const std::string& path, const std::string& what) {
  if (!fault_) fault_ = name_ + ": " + path + ": " + what;
}

void JsonField::refuse_value(const std::string& expected) const { refuse(quoted(*json_) + ", expected " + expected); }

JsonField JsonField::member(const char* key) const {
  const std::string path = path_.empty() ? key : path_ + "." + key;
  static const Json nothing;
  if (!json_->is_object()) {
    refuse_value("an object");
    return {*document_, &nothing, path};
  }
  const auto found = json_->find(key);
  if (found == json_->end()) {
    document_->report(path, "is missing");
    return {*document_, &nothing, path};
  }
  return {*document_, &*found, path};
}

std::optional<JsonField> JsonField::find(const char* key) const {
  if (!json_->is_object()) {
    refuse_value("an object");
    return std::nullopt;
  }
  const auto found = json_->find(key);
  if (found == json_->end() || found->is_null()) return std::nullopt;
  return JsonField(*document_, &*found, path_.empty() ? key : path_ + "." + key);
}

size_t JsonField::size(size_t most) const {
  if (!json_->is_array()) {
    refuse_value("an array");
    return 0;
  }
  if (json_->size() > most) {
    refuse_value("at most " + std::to_string(most));
    return 0;
  }
  return json_->size();
}

bool JsonField::expect_elements(size_t count, const std::string& expected) const {
  const bool holds = json_->is_array() && json_->size() == count;
  if (!holds) refuse("expected " + expected);
  return holds;
}

JsonField JsonField::operator[](size_t index) const {
  return {*document_, &(*json_)[index], path_ + "[" + std::to_string(index) + "]"};
}

double JsonField::number(double lowest, double highest) const {
  if (json_->is_number()) {
    const double number = json_->get<double>();
    if (std::isfinite(number) && number >= lowest && number <= highest) return number;
  }
  refuse_value("a number from " + decimal(lowest) + " to " + decimal(highest));
  return lowest;
}

int64_t JsonField::integer(int64_t lowest, int64_t highest) const {
  std::optional<int64_t> number;
  constexpr uint64_t largest = std::numeric_limits<int64_t>::max();
  constexpr double largest_exact = 9007199254740992.0;  // 2^53: beyond it a double does not name one integer
  if (json_->is_number_unsigned()) {
    if (json_->get<uint64_t>() <= largest) number = json_->get<int64_t>();
  } else if (json_->is_number_integer()) {
    number = json_->get<int64_t>();
  } else if (json_->is_number_float()) {
    const double value = json_->get<double>();
    if (std::abs(value) <= largest_exact && std::trunc(value) == value) number = static_cast<int64_t>(value);
  }
  if (number && *number >= lowest && *number <= highest) return *number;
  refuse_value("an integer from " + std::to_string(lowest) + " to " + std::to_string(highest));
  return lowest;
}

uint64_t JsonField::unsigned_integer() const {
  if (json_->is_number_unsigned()) return json_->get<uint64_t>();
  refuse_value("an integer from 0");
  return 0;
}

bool JsonField::boolean() const {
  if (json_->is_boolean()) return json_->get<bool>();
  refuse_value("true or false");
  return false;
}

std::string JsonField::text(size_t longest) const {
  if (json_->is_string()) {
    const auto& text = json_->get_ref<const std::string&>();
    if (text.size() <= longest && std::none_of(text.begin(), text.end(), is_control)) return text;
  }
  refuse_value("a string of at most " + std::to_string(longest) + " bytes without control characters");
  return {};
}

std::string JsonField::free_text(size_t longest) const {
  if (json_->is_string() && json_->get_ref<const std::string&>().size() <= longest) {
    auto text = json_->get<std::string>();
    std::replace_if(text.begin(), text.end(), is_control, ' ');
    return text;
  }
  refuse_value("a string of at most " + std::to_string(longest) + " bytes");
  return {};
}

std::string JsonField::id() const {
  if (json_->is_string() && is_safe_id(json_->get_ref<const std::string&>())) return json_->get<std::string>();
  refuse_value("a plain name of at most 64 letters, digits, '-', '_' and '.'");
  return {};
}

std::string JsonField::relative_path() const {
  if (json_->is_string() && is_safe_relative_path(json_->get_ref<const std::string&>()))
    return json_->get<std::string>();
  refuse_value("a path inside the recording");
  return {};
}

}  // namespace booth
