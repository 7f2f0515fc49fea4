#include "daemon/redaction.h"

#include <algorithm>
#include <regex>
#include <utility>

namespace booth {
namespace {

/// As make_capture_id makes them.
const std::regex& capture_id() {
  static const std::regex form(R"(\d{4}-\d\d-\d\dT\d\d-\d\d-\d\d(?:\.\d{3})?Z-[0-9a-f]{4})");
  return form;
}

void replace_all(std::string& text, const std::string& what, const std::string& by) {
  for (size_t place = 0; (place = text.find(what, place)) != std::string::npos; place += by.size())
    text.replace(place, what.size(), by);
}

std::vector<std::string> longest_first(std::vector<std::string> words) {
  std::erase_if(words, [](const std::string& word) { return word.empty(); });
  std::sort(words.begin(), words.end(), [](const auto& a, const auto& b) { return a.size() > b.size(); });
  return words;
}

}  // namespace

std::vector<std::string> capture_ids_in(const std::string& text) {
  std::vector<std::string> ids;
  for (std::sregex_iterator found(text.begin(), text.end(), capture_id()), end; found != end; ++found)
    if (std::find(ids.begin(), ids.end(), found->str()) == ids.end()) ids.push_back(found->str());
  return ids;
}

Redaction::Redaction(std::vector<std::string> words) : words_(longest_first(std::move(words))) {}

std::string Redaction::apply(const std::string& text) {
  std::string redacted = text;
  for (const std::string& id : capture_ids_in(text)) {
    const auto [entry, added] = captures_.try_emplace(id);
    if (added) entry->second = "capture-" + std::to_string(captures_.size());
    replace_all(redacted, id, entry->second);
  }
  for (const std::string& word : words_) replace_all(redacted, word, "…");
  return redacted;
}

}  // namespace booth
