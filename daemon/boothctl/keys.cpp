#include "daemon/boothctl/keys.h"

#include <CLI/CLI.hpp>
#include <cstdio>
#include <filesystem>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <string>
#include <system_error>
#include <vector>

#include "config/booth_config.h"
#include "daemon/api/curve_keys.h"
#include "daemon/boothctl/command.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::json;

struct KeysOptions {
  fs::path folder = ApiConfig{}.server_key.parent_path();
  std::string name, role = "kiosk", public_key, out;
  bool replace = false;

  fs::path server_file() const { return folder / "server.key"; }
  fs::path clients() const { return folder / "clients"; }
};

template <class T>
T value_or_fail(Result<T> result) {
  if (!result) throw Failure{exit_refused, result.error().message};
  return std::move(*result);
}
void fail_unless(const Result<void>& result) {
  if (!result) throw Failure{exit_refused, result.error().message};
}

void make_server_key(const KeysOptions& options, bool json) {
  std::error_code code;
  if (fs::exists(options.server_file(), code) && !options.replace)
    throw Failure{exit_refused, options.server_file().string() +
                                    ": is there already; with --replace no client's key works any more until it is "
                                    "given the new server key"};
  fs::create_directories(options.clients(), code);
  if (code) throw Failure{exit_refused, options.clients().string() + ": cannot be made: " + code.message()};
  const auto keys = value_or_fail(api::make_key_pair());
  fail_unless(api::save_server_keys(options.server_file(), keys));
  if (json)
    std::cout << Json{{"file", options.server_file().string()}, {"public_key", keys.public_key}}.dump(2) << "\n";
  else
    std::cout << "the booth's public key is " << keys.public_key << "\n";
}

void add_client(const KeysOptions& options, bool json) {
  const auto server = value_or_fail(api::read_server_keys(options.server_file()));
  api::AllowedClient client{options.name, options.public_key, *api::role_from(options.role), ""};
  const fs::path file = options.out.empty() ? options.name + ".key" : options.out;
  const bool made_elsewhere = !options.public_key.empty();
  api::ClientCredentials credentials{{}, server.public_key};
  if (!made_elsewhere) {
    std::error_code code;
    if (fs::exists(file, code)) throw Failure{exit_refused, file.string() + ": is there already"};
    credentials.keys = value_or_fail(api::make_key_pair());
    client.public_key = credentials.keys.public_key;
  }
  fail_unless(api::allow_client(options.clients(), client));
  if (!made_elsewhere) {
    if (const auto saved = api::save_client_credentials(file, credentials); !saved) {
      // Nobody has its secret key: it is not to be let in.
      static_cast<void>(api::revoke_client(options.clients(), options.name));
      throw Failure{exit_refused, saved.error().message};
    }
  }
  if (json)
    std::cout << Json{{"client", options.name},
                      {"role", options.role},
                      {"public_key", client.public_key},
                      {"server_key", server.public_key},
                      {"file", made_elsewhere ? Json(nullptr) : Json(file.string())}}
                     .dump(2)
              << "\n";
  else if (made_elsewhere)
    std::cout << options.name << " may connect as " << options.role << "; the booth's public key is "
              << server.public_key << "\n";
  else
    std::cout << options.name << " may connect as " << options.role << " with " << file.string()
              << ": hand it over on a safe way and keep no copy\n";
}

void list_clients(const KeysOptions& options, bool json) {
  const auto found = api::read_allowed_clients(options.clients());
  Json list = Json::array();
  for (const api::AllowedClient& client : found.clients) {
    list.push_back({{"client", client.name},
                    {"role", to_string(client.role)},
                    {"public_key", client.public_key},
                    {"created", client.created.empty() ? Json(nullptr) : Json(client.created)}});
    if (!json)
      std::cout << client.name << "  " << to_string(client.role) << "  " << client.public_key << "  " << client.created
                << "\n";
  }
  if (json) std::cout << Json{{"clients", list}, {"faults", found.faults}}.dump(2) << "\n";
  for (const std::string& fault : found.faults) std::cerr << "boothctl: " << fault << "\n";
  if (!found.faults.empty()) throw Failure{exit_refused, "not every file in the folder of keys can be used"};
}

void revoke(const KeysOptions& options, bool json) {
  fail_unless(api::revoke_client(options.clients(), options.name));
  if (json)
    std::cout << Json{{"client", options.name}}.dump(2) << "\n";
  else
    std::cout << options.name << " is no longer let in; a running booth knows within a second\n";
}

}  // namespace

void add_keys_command(CLI::App& app, const bool& json, std::function<void()>& run) {
  const auto options = std::make_shared<KeysOptions>();
  auto* keys = app.add_subcommand("keys", "who may connect over the network, and with which role");
  keys->require_subcommand(1);
  const auto add = [&](const char* name, const char* help, void (*action)(const KeysOptions&, bool)) {
    auto* command = keys->add_subcommand(name, help);
    command->add_option("--folder", options->folder, "where the keys are")->capture_default_str();
    command->callback([&run, &json, options, action] { run = [&json, options, action] { action(*options, json); }; });
    return command;
  };
  add("server", "make the booth's own key", make_server_key)
      ->add_flag("--replace", options->replace, "also where there is one already");
  auto* client = add("add", "let a client in; makes its key file", add_client);
  client->add_option("NAME", options->name, "of the client: letters, digits, '.', '_', '-'")->required();
  client->add_option("--role", options->role, "viewer looks on, kiosk takes captures, operator may everything")
      ->check(CLI::IsMember({"viewer", "kiosk", "operator"}))
      ->capture_default_str();
  client->add_option("--out", options->out, "the client's key file; NAME.key when left out");
  client->add_option("--public-key", options->public_key, "of a key that was made elsewhere");
  add("list", "who is let in", list_clients);
  add("revoke", "let a client in no longer", revoke)->add_option("NAME", options->name)->required();
}

}  // namespace booth
