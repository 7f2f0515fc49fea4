#pragma once

#include <algorithm>
#include <array>
#include <optional>
#include <string_view>

#include "daemon/api/methods.h"

namespace booth::api {

/// What a client is trusted with. Each may all that those before it may.
enum class Role {
  viewer,   ///< looks on: states, numbers, events
  kiosk,    ///< a front end: takes captures, fetches and deletes avatars
  operate,  ///< the operator: everything
};

inline constexpr std::array<std::pair<Role, std::string_view>, 3> role_names{
    {{Role::viewer, "viewer"}, {Role::kiosk, "kiosk"}, {Role::operate, "operator"}}};

constexpr std::string_view to_string(Role role) {
  for (const auto& [known, name] : role_names)
    if (known == role) return name;
  return "";
}

constexpr std::optional<Role> role_from(std::string_view name) {
  for (const auto& [role, known] : role_names)
    if (known == name) return role;
  return std::nullopt;
}

/// A method that is not listed here is the operator's alone, so that a new one opens nothing to anybody.
constexpr Role least_role(Method method) {
  constexpr std::array viewers{Method::system_describe, Method::system_status, Method::system_metrics,
                               Method::system_history, Method::job_list};
  constexpr std::array kiosks{Method::preview_start,  Method::preview_stop, Method::capture_start,
                              Method::capture_cancel, Method::job_cancel,   Method::job_retry,
                              Method::capture_delete, Method::avatar_list,  Method::avatar_get,
                              Method::avatar_fetch,   Method::avatar_delete};
  if (std::find(viewers.begin(), viewers.end(), method) != viewers.end()) return Role::viewer;
  if (std::find(kiosks.begin(), kiosks.end(), method) != kiosks.end()) return Role::kiosk;
  return Role::operate;
}

constexpr bool may(Role role, Method method) { return role >= least_role(method); }

}  // namespace booth::api
