#include "daemon/api/errors.h"

#include <algorithm>
#include <iterator>

namespace booth::api {
namespace {

struct Row {
  ErrorCode code;
  RpcError error;
};
constexpr Row table[] = {{ErrorCode::invalid_argument, {-32602, "invalid_params"}},
                         {ErrorCode::busy, {-32000, "busy"}},
                         {ErrorCode::not_found, {-32001, "not_found"}},
                         {ErrorCode::device_lost, {-32002, "camera_unavailable"}},
                         {ErrorCode::not_calibrated, {-32003, "not_calibrated"}},
                         {ErrorCode::no_background, {-32004, "no_background"}},
                         {ErrorCode::disk_full, {-32005, "disk_full"}},
                         {ErrorCode::invalid_state, {-32006, "invalid_state"}},
                         {ErrorCode::unsupported, {-32007, "unsupported"}},
                         {ErrorCode::not_ready, {-32008, "not_ready"}},
                         {ErrorCode::internal, {-32099, "internal"}}};

const Row* find(ErrorCode code) {
  const auto* row = std::find_if(std::begin(table), std::end(table), [&](const Row& r) { return r.code == code; });
  return row == std::end(table) ? nullptr : row;
}

}  // namespace

RpcError rpc_error(ErrorCode code) {
  const Row* row = find(code);
  return row != nullptr ? row->error : find(ErrorCode::internal)->error;
}

std::string event_kind(ErrorCode code) {
  const Row* row = find(code);
  return std::string(row != nullptr ? row->error.kind : to_string(code));
}

}  // namespace booth::api
