#include "pipeline/thread_pool.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <atomic>
#include <mutex>
#include <numeric>
#include <set>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace booth {
namespace {

/// How often a loop over [0, count) calls for each index.
std::vector<int> visits(const Work& work, size_t count, size_t grain) {
  std::vector<std::atomic<int>> seen(count);
  work.parallel_for(count, grain, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) ++seen[i];
  });
  return {seen.begin(), seen.end()};
}

class ThreadPoolOf : public testing::TestWithParam<unsigned> {};

TEST_P(ThreadPoolOf, CoversEveryIndexOnce) {
  ThreadPool pool(GetParam());
  EXPECT_EQ(pool.threads(), GetParam());
  for (const size_t count : {0U, 1U, 2U, 7U, 64U, 1000U})
    for (const size_t grain : {0U, 1U, 3U, 64U, 5000U})
      EXPECT_THAT(visits(pool.work(), count, grain), testing::Each(1)) << count << " by " << grain;
}

TEST_P(ThreadPoolOf, SplitsTheSameWithoutThreads) {
  ThreadPool pool(GetParam());
  std::mutex mutex;
  std::set<std::pair<size_t, size_t>> pieces, serial;
  pool.run(103, 10, [&](size_t begin, size_t end) {
    const std::lock_guard lock(mutex);
    pieces.emplace(begin, end);
  });
  Work{}.parallel_for(103, 10, [&](size_t begin, size_t end) { serial.emplace(begin, end); });
  EXPECT_EQ(pieces, serial);
}

TEST_P(ThreadPoolOf, ThrowsAPiecesExceptionAgainAndStaysUsable) {
  ThreadPool pool(GetParam());
  for (int round = 0; round < 20; ++round) {
    try {
      pool.run(100, 1, [&](size_t begin, size_t) {
        if (begin % 10 == 3) throw std::runtime_error("piece");
      });
      FAIL() << "nothing was thrown";
    } catch (const std::runtime_error& error) {
      EXPECT_EQ(std::string(error.what()), "piece");
    }
    EXPECT_THAT(visits(pool.work(), 50, 2), testing::Each(1));
  }
}

TEST_P(ThreadPoolOf, RunsLoopsWithinPieces) {
  ThreadPool pool(GetParam());
  for (int round = 0; round < 50; ++round) {
    std::vector<std::atomic<int>> seen(8 * 8 * 8);
    pool.run(8, 1, [&](size_t outer, size_t) {
      pool.run(8, 3, [&](size_t begin, size_t end) {
        for (size_t middle = begin; middle < end; ++middle)
          pool.run(8, 1, [&](size_t inner, size_t) { ++seen[(outer * 8 + middle) * 8 + inner]; });
      });
    });
    ASSERT_THAT(std::vector<int>(seen.begin(), seen.end()), testing::Each(1));
  }
}

TEST_P(ThreadPoolOf, ThrowsOutOfLoopsWithinPieces) {
  ThreadPool pool(GetParam());
  const auto fails = [&] {
    pool.run(4, 1, [&](size_t outer, size_t) {
      pool.run(4, 1, [&](size_t inner, size_t) {
        if (outer == 2 && inner == 1) throw std::runtime_error("piece");
      });
    });
  };
  EXPECT_THROW(fails(), std::runtime_error);
  EXPECT_THAT(visits(pool.work(), 50, 2), testing::Each(1));
}

TEST_P(ThreadPoolOf, ServesSeveralCallers) {
  ThreadPool pool(GetParam());
  std::atomic<int> wrong{0};
  {
    std::vector<std::jthread> callers;
    for (int caller = 0; caller < 4; ++caller)
      callers.emplace_back([&] {
        for (int round = 0; round < 50; ++round)
          for (const int times : visits(pool.work(), 40, 3))
            if (times != 1) ++wrong;
      });
  }
  EXPECT_EQ(wrong, 0);
}

TEST_P(ThreadPoolOf, SeesWhatPiecesWroteAfterTheLoop) {
  ThreadPool pool(GetParam());
  std::vector<size_t> numbers(257);  // not atomic: the end of a loop orders memory
  for (size_t round = 0; round < 300; ++round) {
    pool.run(numbers.size(), 16, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) numbers[i] = i + round;
    });
    const size_t sum = std::accumulate(numbers.begin(), numbers.end(), size_t{0});
    ASSERT_EQ(sum, numbers.size() * (numbers.size() - 1) / 2 + numbers.size() * round);
  }
}

INSTANTIATE_TEST_SUITE_P(Threads, ThreadPoolOf, testing::Values(1U, 2U, 3U, 8U));

TEST(ThreadPool, UsesItsThreadsAtTheSameTime) {
  ThreadPool pool(3);
  // Every piece waits until all three have begun: with fewer threads at work this would never end.
  std::atomic<int> begun{0};
  pool.run(3, 1, [&](size_t, size_t) {
    ++begun;
    while (begun < 3) std::this_thread::yield();
  });
  EXPECT_EQ(begun, 3);
}

TEST(ThreadPool, LendsAnIdleThreadToALoopWithinAPiece) {
  ThreadPool pool(2);
  std::atomic<bool> second_done{false};
  std::atomic<int> begun{0};
  // The second piece is over at once; its thread must then join the loop inside the first, or this would never end.
  pool.work().both(
      [&] {
        while (!second_done) std::this_thread::yield();
        pool.run(2, 1, [&](size_t, size_t) {
          ++begun;
          while (begun < 2) std::this_thread::yield();
        });
      },
      [&] { second_done = true; });
  EXPECT_EQ(begun, 2);
}

TEST(Work, DoesBothWithAndWithoutThreads) {
  ThreadPool pool(2);
  for (const Work& work : {Work{}, pool.work()}) {
    int first = 0, second = 0;
    work.both([&] { ++first; }, [&] { ++second; });
    EXPECT_EQ(first, 1);
    EXPECT_EQ(second, 1);
  }
}

TEST(ThreadPool, TakesAllProcessorsUnlessTold) {
  EXPECT_EQ(ThreadPool().threads(), std::max(1U, std::thread::hardware_concurrency()));
}

TEST(ThreadPool, ComesAndGoesIdle) {
  for (int i = 0; i < 50; ++i) ThreadPool pool(4);
}

}  // namespace
}  // namespace booth
