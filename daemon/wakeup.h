#pragma once

namespace booth {

/// Wakes a thread that sleeps in poll(): any thread signals, the sleeper polls fd() for reading and clears it.
class Wakeup {
 public:
  Wakeup();
  ~Wakeup();
  Wakeup(const Wakeup&) = delete;
  Wakeup& operator=(const Wakeup&) = delete;

  int fd() const { return fd_; }
  void signal() noexcept;
  void clear() noexcept;

 private:
  int fd_;
};

}  // namespace booth
