#include "daemon/board_session.h"

#include <algorithm>
#include <system_error>

namespace booth {

std::vector<std::string> BoardSession::shots() const {
  std::vector<std::string> names;
  std::error_code code;  // a folder that is not there holds none
  for (std::filesystem::directory_iterator entry(shots_folder(), code), end; !code && entry != end;
       entry.increment(code))
    if (const std::string name = entry->path().filename().string(); !name.starts_with('.')) names.push_back(name);
  std::sort(names.begin(), names.end());
  return names;
}

}  // namespace booth
