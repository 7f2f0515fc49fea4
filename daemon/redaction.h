#pragma once

#include <map>
#include <string>
#include <vector>

namespace booth {

/// Takes people out of texts that leave the booth: ids of captures, which tell when somebody was there, become
/// "capture-1", the same one the same each time; words that were said to be private become "…".
class Redaction {
 public:
  /// @param words  labels, for example; empty ones are left out
  explicit Redaction(std::vector<std::string> words);

  std::string apply(const std::string& text);

 private:
  const std::vector<std::string> words_;  ///< the longest first
  std::map<std::string, std::string> captures_;
};

/// Every id of a capture in a text, in the order in which they stand there, each once.
std::vector<std::string> capture_ids_in(const std::string& text);

}  // namespace booth
