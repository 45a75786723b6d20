#include "emulated.h"

#include <algorithm>
#include <numeric>
#include <stdexcept>

namespace refdgs::cuda {

namespace {

constexpr size_t kStack = 64 << 10;

}  // namespace

Fibers::Fibers(int threads, unsigned order)
    : threads_(threads), fibers_(size_t(threads)), turns_(size_t(threads)), warps_(size_t(threads / kWarp)) {
  for (Fiber& fiber : fibers_) fiber.stack.reset(new char[kStack]);
  std::iota(turns_.begin(), turns_.end(), 0);
  if (order == 1) std::reverse(turns_.begin(), turns_.end());
  if (order > 1) std::shuffle(turns_.begin(), turns_.end(), std::mt19937(order));
}

void Fibers::enter(unsigned high, unsigned low) {
  auto* self = reinterpret_cast<Fibers*>(uintptr_t(high) << 32 | low);
  const int thread = self->current_;
  self->body_(self->argument_, thread);
  self->fibers_[size_t(thread)].done = true;
  self->moved_ = true;
  _longjmp(self->home_, 1);
}

// Going back and forth by _longjmp asks nothing of the system; only the first entry does.
void Fibers::resume(int thread) {
  Fiber& fiber = fibers_[size_t(thread)];
  current_ = thread;
  if (_setjmp(home_)) return;
  if (fiber.begun) _longjmp(fiber.at, 1);
  fiber.begun = true;
  setcontext(&fiber.entry);
}

void Fibers::yield() {
  const int thread = current_;
  if (!_setjmp(fibers_[size_t(thread)].at)) _longjmp(home_, 1);
}

void Fibers::wait(Gate& gate, int all) {
  const unsigned turn = gate.turn;
  moved_ = true;
  if (++gate.come == all) {
    gate.come = 0;
    ++gate.turn;
    return;
  }
  while (gate.turn == turn) yield();
  moved_ = true;
}

uint32_t Fibers::ballot(int thread, bool p) {
  Warp& w = warps_[size_t(thread / kWarp)];
  char* slots = w.slots[w.gate.turn & 1];
  slots[8 * (thread % kWarp)] = char(p);
  wait(w.gate, kWarp);
  uint32_t bits = 0;
  for (int lane = 0; lane < kWarp; ++lane) bits |= uint32_t(slots[8 * lane] != 0) << lane;
  return bits;
}

void Fibers::start(void (*body)(void*, int), void* argument) {
  body_ = body, argument_ = argument;
  const auto self = reinterpret_cast<uintptr_t>(this);
  for (Fiber& fiber : fibers_) {
    fiber.begun = fiber.done = false;
    getcontext(&fiber.entry);
    fiber.entry.uc_stack.ss_sp = fiber.stack.get();
    fiber.entry.uc_stack.ss_size = kStack;
    fiber.entry.uc_link = nullptr;
    makecontext(&fiber.entry, reinterpret_cast<void (*)()>(&Fibers::enter), 2, unsigned(self >> 32), unsigned(self));
  }
  int left = threads_;
  while (left) {
    moved_ = false;
    for (const int thread : turns_) {
      if (fibers_[size_t(thread)].done) continue;
      resume(thread);
      left -= fibers_[size_t(thread)].done;
    }
    if (!moved_) throw std::logic_error("a barrier or exchange that not every thread reaches");
  }
}

void EmulatedQueue::zero(void* at, size_t bytes) const { if (bytes) ++launches, std::memset(at, 0, bytes); }

void EmulatedQueue::scan(int64_t* values, int64_t count, void*, size_t) const {
  ++launches;
  std::exclusive_scan(values, values + count, values, int64_t(0));
}

}  // namespace refdgs::cuda
