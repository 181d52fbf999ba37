#include "common/pool.h"

#include "common/threads.h"

#include <pthread.h>
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <ctime>
#include <mutex>
#if defined(__linux__)
#include <sched.h>
#endif
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace rtgs {
namespace {

constexpr int64_t kAwake = 400'000;           // ns that a thread waits before it sleeps
constexpr int64_t kInterrupted = 200'000;     // ns between two looks at the clock: the thread was not running
constexpr int64_t kLeastCalm = 20'000'000, kMostCalm = 2'000'000'000;  // ns in which no thread waits awake
constexpr int kPauses = 16;                   // between two looks at the clock
constexpr size_t kStack = 8 << 20;            // bytes; a tile's state is on it

int64_t now() {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

void pause() {
#if defined(__x86_64__)
  _mm_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

int cores() {  // that this process may use
#if defined(__linux__)
  cpu_set_t allowed;
  if (sched_getaffinity(0, sizeof allowed, &allowed) == 0) return CPU_COUNT(&allowed);
#endif
  const long found = sysconf(_SC_NPROCESSORS_ONLN);
  return found > 0 ? int(found) : 1;
}

int64_t worked() {  // ns that this thread has run
  timespec time;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
  return int64_t(time.tv_sec) * 1'000'000'000 + time.tv_nsec;
}

// Whether threads may wait awake: not for a while after one of them was interrupted.
std::atomic<int64_t> calm_until{0}, calm{kLeastCalm};
std::atomic<int64_t> spent_awake{0};

void calm_down(int64_t time) {
  const int64_t until = calm_until.load(std::memory_order_relaxed), before = calm.load(std::memory_order_relaxed);
  const bool again = time - until < 4 * before;
  const bool longer = again && time >= until;  // not twice for what the same while saw
  const int64_t next = !again ? kLeastCalm : longer ? std::min(2 * before, kMostCalm) : before;
  calm.store(next, std::memory_order_relaxed);
  calm_until.store(time + next, std::memory_order_relaxed);
}

// Waits that end when a condition holds, awake at first.
class Waiting {
 public:
  template <class Done>
  void wait(const Done& done) {
    if (awake(done)) return;
    std::unique_lock<std::mutex> lock(mutex_);
    ++sleepers_;
    wake_.wait(lock, done);
    --sleepers_;
  }
  // After what `done` looks at has changed: to `most` of those who wait, first to the awake.
  void tell(int most) {
    most -= awake_.load();
    if (sleepers_ == 0 || most <= 0) return;
    std::lock_guard<std::mutex> lock(mutex_);
    if (most >= sleepers_) wake_.notify_all();
    else
      for (int k = 0; k < most; ++k) wake_.notify_one();
  }

 private:
  template <class Done>
  bool awake(const Done& done) {
    const int64_t began = now();
    if (began < calm_until.load(std::memory_order_relaxed)) return done();
    ++awake_;
    int64_t last = began;
    bool found = false;
    while (!found && last < began + kAwake && last >= calm_until.load(std::memory_order_relaxed)) {
      for (int k = 0; k < kPauses && !found; ++k) {
        found = done();
        pause();
      }
      const int64_t time = now();
      if (time - last > kInterrupted) calm_down(time);
      else spent_awake.fetch_add(time - last, std::memory_order_relaxed);
      last = time;
    }
    --awake_;
    return found || done();
  }

  std::mutex mutex_;
  std::condition_variable wake_;
  std::atomic<int> sleepers_{0}, awake_{0};
};

// Number of the job, its parts, and the next of them: in one word, so that a thread that takes a part knows of which job.
struct Ticket {
  uint64_t word;
  uint32_t job() const { return uint32_t(word >> 32); }
  int parts() const { return int(word >> 16 & 0xffff); }
  int next() const { return int(word & 0xffff); }
  static_assert(2 * kMostThreads < 0xffff);  // a draw in vain or two for each thread
  static uint64_t first(uint32_t job, int parts) { return uint64_t(job) << 32 | uint64_t(parts) << 16; }
};

class Pool {
 public:
  void run(int parts, PartOfWork work, void* context) {
    hire(parts - 1);
    work_ = work, context_ = context;
    left_.store(parts, std::memory_order_relaxed);
    tickets_.store(Ticket::first(++jobs_, parts));
    idle_.tell(parts - 1);
    take_parts();
    ended_.wait([this] { return left_.load() == 0; });
  }

 private:
  // Threads never end: with the process. More than cores bring nothing.
  void hire(int wanted) {
    if (wanted > most_) wanted = most_;
    sigset_t all, before;
    sigfillset(&all);
    if (hired_ < wanted) pthread_sigmask(SIG_SETMASK, &all, &before);  // signals are for the threads of Python
    else return;
    for (; hired_ < wanted; ++hired_) {
      pthread_attr_t attributes;
      pthread_t thread;
      pthread_attr_init(&attributes);
      pthread_attr_setstacksize(&attributes, kStack);
      pthread_attr_setdetachstate(&attributes, PTHREAD_CREATE_DETACHED);
      const int failed = pthread_create(&thread, &attributes, serve, this);
      pthread_attr_destroy(&attributes);
      if (failed) {  // the parts are done all the same
        most_ = hired_;
        break;
      }
    }
    pthread_sigmask(SIG_SETMASK, &before, nullptr);
  }
  static void* serve(void* pool) {
    static_cast<Pool*>(pool)->serve_forever();
    return nullptr;
  }
  void serve_forever();
  void take_parts() {
    const int64_t began = now(), before = worked();
    for (;;) {
      const Ticket ticket{tickets_.fetch_add(1)};
      if (ticket.next() >= ticket.parts()) break;
      work_(context_, ticket.next());
      if (left_.fetch_sub(1) == 1) ended_.tell(1);
    }
    const int64_t time = now();
    if (time - began - (worked() - before) > kInterrupted) calm_down(time);
  }

  alignas(64) std::atomic<uint64_t> tickets_{0};  // idle threads look at it all the time
  alignas(64) std::atomic<int> left_{0};
  PartOfWork work_ = nullptr;
  void* context_ = nullptr;
  uint32_t jobs_ = 0;
  int hired_ = 0, most_ = cores() - 1;
  Waiting idle_, ended_;
};

thread_local bool inside = false;  // of a part, or of a call that waits for its parts

void Pool::serve_forever() {
  inside = true;
  uint32_t seen = 0;
  for (;;) {
    idle_.wait([this, seen] { return Ticket{tickets_.load()}.job() != seen; });
    seen = Ticket{tickets_.load()}.job();
    take_parts();
  }
}

Pool* pool = new Pool;  // never deleted: its threads end with the process, after all destructors
std::atomic<bool> busy{false};

}  // namespace

void run_parts(int parts, PartOfWork work, void* context) {
  if (parts <= 1 || inside || busy.exchange(true)) {
    for (int part = 0; part < parts; ++part) work(context, part);
    return;
  }
  inside = true;
  pool->run(parts, work, context);
  inside = false;
  busy.store(false);
}

int64_t time_awake() { return spent_awake.load(std::memory_order_relaxed); }

}  // namespace rtgs
