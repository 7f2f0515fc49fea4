#include "pipeline/segmentation/minimum_cut.h"

#include <algorithm>
#include <deque>
#include <limits>

namespace booth::segmentation {
namespace {

/// The two search trees of Boykov and Kolmogorov over a graph's residual capacities.
class TwoTreeFlow {
 public:
  explicit TwoTreeFlow(CutGraph graph) : nodes_(std::move(graph.nodes)), state_(nodes_.size()) {}

  std::vector<uint8_t> solve() {
    plant();
    int32_t current = none;
    while (true) {
      if (current == none || state_[current].parent == no_parent) {
        current = next_active();
        if (current == none) break;
      }
      Contact contact;
      if (!grow(current, &contact)) {
        current = none;
        continue;
      }
      ++time_;
      augment(contact);
      adopt();
    }
    std::vector<uint8_t> source_side(nodes_.size());
    for (size_t i = 0; i < nodes_.size(); ++i) source_side[i] = state_[i].parent != no_parent && !state_[i].sink;
    return source_side;
  }

 private:
  static constexpr int32_t none = -1;
  // A parent is the direction towards it, or one of these.
  static constexpr int8_t no_parent = -1;
  static constexpr int8_t terminal_parent = 8;
  static constexpr int8_t orphan = 9;

  struct State {
    int8_t parent = no_parent;
    bool sink = false;
    bool queued = false;
    int32_t distance = 0;  ///< to the terminal, as known at `stamp`
    int32_t stamp = 0;
  };
  struct Contact {
    int32_t source = none, sink = none;
    int direction = 0;  ///< from source to sink
  };

  void plant() {
    for (size_t i = 0; i < nodes_.size(); ++i) {
      if (nodes_[i].terminal == 0) continue;
      state_[i].parent = terminal_parent;
      state_[i].sink = nodes_[i].terminal < 0;
      state_[i].distance = 1;
      activate(static_cast<int32_t>(i));
    }
  }

  void activate(int32_t i) {
    if (state_[i].queued) return;
    state_[i].queued = true;
    active_.push_back(i);
  }

  int32_t next_active() {
    while (!active_.empty()) {
      const int32_t i = active_.front();
      active_.pop_front();
      state_[i].queued = false;
      if (state_[i].parent != no_parent) return i;
    }
    return none;
  }

  /// Residual capacity in the direction in which flow would run through a tree's edge between i and its neighbour.
  int32_t residual_outwards(int32_t i, int k) const {
    return state_[i].sink ? nodes_[nodes_[i].neighbor[k]].capacity[7 - k] : nodes_[i].capacity[k];
  }

  bool grow(int32_t i, Contact* contact) {
    for (int k = 0; k < 8; ++k) {
      const int32_t j = nodes_[i].neighbor[k];
      if (j == none || residual_outwards(i, k) == 0) continue;
      State& other = state_[j];
      if (other.parent == no_parent) {
        other.sink = state_[i].sink;
        other.parent = static_cast<int8_t>(7 - k);
        other.stamp = state_[i].stamp;
        other.distance = state_[i].distance + 1;
        activate(j);
      } else if (other.sink != state_[i].sink) {
        *contact = state_[i].sink ? Contact{j, i, 7 - k} : Contact{i, j, k};
        return true;
      } else if (other.stamp <= state_[i].stamp && other.distance > state_[i].distance && other.parent < 8) {
        // A shorter way to the terminal keeps later searches short.
        other.parent = static_cast<int8_t>(7 - k);
        other.stamp = state_[i].stamp;
        other.distance = state_[i].distance + 1;
      }
    }
    return false;
  }

  void augment(const Contact& contact) {
    int32_t bottleneck = nodes_[contact.source].capacity[contact.direction];
    int32_t i = contact.source;
    while (state_[i].parent != terminal_parent) {
      const int k = state_[i].parent;
      const int32_t up = nodes_[i].neighbor[k];
      bottleneck = std::min(bottleneck, nodes_[up].capacity[7 - k]);
      i = up;
    }
    bottleneck = std::min(bottleneck, nodes_[i].terminal);
    i = contact.sink;
    while (state_[i].parent != terminal_parent) {
      const int k = state_[i].parent;
      bottleneck = std::min(bottleneck, nodes_[i].capacity[k]);
      i = nodes_[i].neighbor[k];
    }
    bottleneck = std::min(bottleneck, -nodes_[i].terminal);

    nodes_[contact.source].capacity[contact.direction] -= bottleneck;
    nodes_[contact.sink].capacity[7 - contact.direction] += bottleneck;
    i = contact.source;
    while (state_[i].parent != terminal_parent) {
      const int k = state_[i].parent;
      const int32_t up = nodes_[i].neighbor[k];
      nodes_[i].capacity[k] += bottleneck;
      nodes_[up].capacity[7 - k] -= bottleneck;
      if (nodes_[up].capacity[7 - k] == 0) make_orphan(i);
      i = up;
    }
    nodes_[i].terminal -= bottleneck;
    if (nodes_[i].terminal == 0) make_orphan(i);
    i = contact.sink;
    while (state_[i].parent != terminal_parent) {
      const int k = state_[i].parent;
      const int32_t up = nodes_[i].neighbor[k];
      nodes_[i].capacity[k] -= bottleneck;
      nodes_[up].capacity[7 - k] += bottleneck;
      if (nodes_[i].capacity[k] == 0) make_orphan(i);
      i = up;
    }
    nodes_[i].terminal += bottleneck;
    if (nodes_[i].terminal == 0) make_orphan(i);
  }

  void make_orphan(int32_t i) {
    state_[i].parent = orphan;
    orphans_.push_back(i);
  }

  /// Capacity left from a would-be parent (in direction k) to i, in the direction of i's tree's flow.
  int32_t residual_inwards(int32_t i, int k) const {
    return state_[i].sink ? nodes_[i].capacity[k] : nodes_[nodes_[i].neighbor[k]].capacity[7 - k];
  }

  /// Steps from i to its terminal along parents, or a huge number when the way ends at an orphan.
  int32_t distance_to_terminal(int32_t i) {
    int32_t steps = 0;
    int32_t j = i;
    while (true) {
      State& s = state_[j];
      if (s.stamp == time_) {
        steps += s.distance;
        break;
      }
      ++steps;
      if (s.parent == terminal_parent) {
        s.stamp = time_;
        s.distance = 1;
        break;
      }
      if (s.parent == orphan || s.parent == no_parent) return far_away;
      j = nodes_[j].neighbor[s.parent];
    }
    for (int32_t left = steps; state_[i].stamp != time_; --left) {
      state_[i].stamp = time_;
      state_[i].distance = left;
      i = nodes_[i].neighbor[state_[i].parent];
    }
    return steps;
  }

  void adopt() {
    while (!orphans_.empty()) {
      const int32_t i = orphans_.front();
      orphans_.pop_front();
      int best = -1;
      int32_t best_distance = far_away;
      for (int k = 0; k < 8; ++k) {
        const int32_t j = nodes_[i].neighbor[k];
        if (j == none || state_[j].parent == no_parent || state_[j].sink != state_[i].sink) continue;
        if (residual_inwards(i, k) == 0) continue;
        const int32_t distance = distance_to_terminal(j);
        if (distance < best_distance) {
          best_distance = distance;
          best = k;
        }
      }
      if (best >= 0) {
        state_[i].parent = static_cast<int8_t>(best);
        state_[i].stamp = time_;
        state_[i].distance = best_distance + 1;
        continue;
      }
      for (int k = 0; k < 8; ++k) {
        const int32_t j = nodes_[i].neighbor[k];
        if (j == none || state_[j].parent == no_parent || state_[j].sink != state_[i].sink) continue;
        if (residual_inwards(i, k) > 0) activate(j);
        if (state_[j].parent == 7 - k) make_orphan(j);
      }
      state_[i].parent = no_parent;
    }
  }

  static constexpr int32_t far_away = std::numeric_limits<int32_t>::max() / 2;

  std::vector<CutGraph::Node> nodes_;
  std::vector<State> state_;
  std::deque<int32_t> active_;
  std::deque<int32_t> orphans_;
  int32_t time_ = 0;
};

}  // namespace

std::vector<uint8_t> minimum_cut(CutGraph graph) { return TwoTreeFlow(std::move(graph)).solve(); }

}  // namespace booth::segmentation
