#pragma once

#include <map>
#include <string>

namespace booth {

/// The booth's measurements in Prometheus' text format (0.0.4): NAME becomes booth_NAME, and what Metrics::observe
/// counted a histogram. Characters that a name may not have become '_'.
std::string prometheus_text(const std::map<std::string, double>& measurements);

}  // namespace booth
