#pragma once

#include <string>
#include <string_view>

#include "pipeline/types/result.h"

namespace booth::api {

/// An error as the interface names it.
struct RpcError {
  int code;
  std::string_view kind;
};

// Of the protocol itself.
inline constexpr RpcError parse_error{-32700, "parse_error"};
inline constexpr RpcError invalid_request{-32600, "invalid_request"};
inline constexpr RpcError unknown_method{-32601, "unknown_method"};

/// Of the interface: the client's role may not do that.
inline constexpr RpcError forbidden{-32009, "forbidden"};

/// Of the booth: the one table from error codes to the interface's codes and kinds.
RpcError rpc_error(ErrorCode code);

/// The kind of an error in an event: that of the table, or the code's own name where the interface has no word for it
/// ("timeout", "cancelled").
std::string event_kind(ErrorCode code);

}  // namespace booth::api
