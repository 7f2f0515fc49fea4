#include "daemon/prometheus.h"

#include <cmath>
#include <set>
#include <sstream>

namespace booth {
namespace {

std::string metric_name(const std::string& name) {
  std::string made = "booth_" + name;
  for (char& c : made)
    if (!((c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '_')) c = '_';
  return made;
}

}  // namespace

std::string prometheus_text(const std::map<std::string, double>& measurements) {
  constexpr const char* bucket = "_le_";
  constexpr int digits = 15;
  std::ostringstream text;
  text.precision(digits);
  std::set<std::string> histograms;
  for (const auto& [name, value] : measurements)
    if (const size_t place = name.rfind(bucket); place != std::string::npos) histograms.insert(name.substr(0, place));
  const auto belongs_to_histogram = [&](const std::string& name) {
    for (const std::string& histogram : histograms)
      if (name == histogram + "_count" || name == histogram + "_sum" || name.starts_with(histogram + bucket))
        return true;
    return false;
  };
  std::set<std::string> written;
  for (const auto& [name, value] : measurements) {
    // Two that differ in forbidden characters only: the first has the name.
    if (belongs_to_histogram(name) || !std::isfinite(value) || !written.insert(metric_name(name)).second) continue;
    text << "# TYPE " << metric_name(name) << " untyped\n" << metric_name(name) << " " << value << "\n";
  }
  for (const std::string& histogram : histograms) {
    const auto count = measurements.find(histogram + "_count"), sum = measurements.find(histogram + "_sum");
    if (count == measurements.end() || sum == measurements.end()) continue;
    const std::string name = metric_name(histogram);
    text << "# TYPE " << name << " histogram\n";
    std::map<double, double> buckets;  // Prometheus wants them in the order of their bounds
    for (auto entry = measurements.lower_bound(histogram + bucket);
         entry != measurements.end() && entry->first.starts_with(histogram + bucket); ++entry)
      buckets[std::stod(entry->first.substr(histogram.size() + std::string(bucket).size()))] = entry->second;
    for (const auto& [bound, below] : buckets) text << name << "_bucket{le=\"" << bound << "\"} " << below << "\n";
    text << name << "_bucket{le=\"+Inf\"} " << count->second << "\n"
         << name << "_sum " << sum->second << "\n"
         << name << "_count " << count->second << "\n";
  }
  return text.str();
}

}  // namespace booth
