// MuJoCo behind XLA's foreign function interface: a reset and a step, as pure functions.
//
// A state goes in and comes out, from which MuJoCo goes on exactly where it was: its integration
// state, then the positions of all bodies as it computed them last, `Length` doubles in all. Each
// double is a pair of 32-bit words, since JAX has no doubles by default. The positions of bodies
// lag behind the joints by a part of a step, and some of Gymnasium's rewards are made of them.
//
// Leading axes of the arguments are a batch, whose elements are stepped one after the other. Each
// thread has its own workspace (mjData) for each model. What one call leaves there has no effect on
// the next call.

#include <algorithm>
#include <cfenv>
#include <cstdint>
#include <functional>
#include <initializer_list>
#include <memory>
#include <mutex>
#include <numeric>
#include <shared_mutex>
#include <string>
#include <unordered_map>

#include <mujoco/mujoco.h>

#include "xla/ffi/api/ffi.h"

namespace {

namespace ffi = xla::ffi;
using Words = ffi::Buffer<ffi::U32>;
using Floats = ffi::Buffer<ffi::F32>;
using Axes = ffi::Span<const int64_t>;

constexpr int kState = mjSTATE_INTEGRATION;

struct FreeData {
  void operator()(mjData* data) const { mj_deleteData(data); }
};

struct Workspace {
  const mjModel* model = nullptr;
  std::unique_ptr<mjData, FreeData> data;
};

// All models by number. The map only grows, and is never destroyed: XLA's threads may outlive it.
struct Models {
  std::shared_mutex mutex;
  std::unordered_map<int64_t, const mjModel*> by_id;
};

Models& AllModels() {
  static Models& models = *new Models();
  return models;
}

// This thread's workspace for a model; its model is null if no model has that number.
Workspace& WorkspaceOf(int64_t id) {
  thread_local std::unordered_map<int64_t, Workspace> workspaces;
  Workspace& found = workspaces[id];
  if (found.model == nullptr) {
    Models& all = AllModels();
    std::shared_lock lock(all.mutex);
    if (auto model = all.by_id.find(id); model != all.by_id.end()) {
      found.model = model->second;
      found.data.reset(mj_makeData(found.model));
    }
  }
  return found;
}

// XLA lets its threads round denormal numbers to zero. This scope keeps these numbers, as any other
// program that calls MuJoCo does.
class DefaultFloatingPoint {
 public:
  DefaultFloatingPoint() {
    std::fegetenv(&before_);
    std::fesetenv(FE_DFL_ENV);
  }
  ~DefaultFloatingPoint() { std::fesetenv(&before_); }

 private:
  std::fenv_t before_;
};

// MuJoCo prints and logs the first warning of each kind. Counting one beforehand prevents it: a
// call has no effect but its result.
void Silence(mjData* d) {
  for (int i = 0; i < mjNWARNING; ++i) d->warning[i].number = 1;
}

int64_t Length(const mjModel* m) { return mj_stateSize(m, kState) + 3 * m->nbody; }

int64_t BatchSize(Axes axes) {
  return std::accumulate(axes.begin(), axes.end() - 1, int64_t{1}, std::multiplies<int64_t>());
}

std::string Show(Axes axes) {
  std::string text = "[";
  for (size_t i = 0; i < axes.size(); ++i) text += (i ? ", " : "") + std::to_string(axes[i]);
  return text + "]";
}

// An array that must have shape `[*batch, length]`.
struct Expected {
  const char* name;
  Axes axes;
  int64_t length;
};

// An error unless all arrays have their lengths, and the same leading axes.
ffi::Error Check(std::initializer_list<Expected> arrays) {
  Axes first = arrays.begin()->axes;
  for (const auto& [name, axes, length] : arrays) {
    bool fits = axes.size() >= 1 && axes.size() == first.size() &&
                axes[axes.size() - 1] == length &&
                std::equal(axes.begin(), axes.end() - 1, first.begin());
    if (!fits) {
      return ffi::Error::InvalidArgument(
          std::string(name) + " must have shape [*batch, " + std::to_string(length) +
          "], because that is its length in this model and the batch is that of " +
          arrays.begin()->name + ", which is " + Show(first) + "; got " + Show(axes));
    }
  }
  return ffi::Error::Success();
}

ffi::Error Unknown(int64_t id) {
  return ffi::Error(ffi::ErrorCode::kNotFound,
                    "model must be one that is registered; got " + std::to_string(id) +
                        ". Make the task before a program is run that was compiled for it");
}

// A call's results for each element of the batch: the state, and a report of single-precision
// numbers. The report has qpos, qvel, the change of qpos, xpos, the change of xpos, and if there is
// room for it, cfrc_ext, whose computation takes time.
class Results {
 public:
  Results(const mjModel* m, Words state, Floats report) : m_(m), state_(state), report_(report) {
    Axes axes = report.dimensions();
    has_forces_ = axes.size() > 0 && axes[axes.size() - 1] == ReportLength(true);
  }

  bool has_forces() const { return has_forces_; }
  Expected state() const { return {"the next state", state_.dimensions(), 2 * Length(m_)}; }
  Expected report() const {
    return {"the report", report_.dimensions(), ReportLength(has_forces_)};
  }

  // Writes element `b`: MuJoCo's state, and its report with the changes.
  void Write(int64_t b, const mjData* d, const mjtNum* qpos_before, const mjtNum* xpos_before) {
    mjtNum* state = reinterpret_cast<mjtNum*>(state_.typed_data()) + b * Length(m_);
    mj_getState(m_, d, state, kState);
    std::copy_n(d->xpos, 3 * m_->nbody, state + mj_stateSize(m_, kState));
    float* out = report_.typed_data() + b * ReportLength(has_forces_);
    out = std::copy_n(d->qpos, m_->nq, out);
    out = std::copy_n(d->qvel, m_->nv, out);
    out = PutChange(d->qpos, qpos_before, m_->nq, out);
    out = std::copy_n(d->xpos, 3 * m_->nbody, out);
    out = PutChange(d->xpos, xpos_before, 3 * m_->nbody, out);
    if (has_forces_) std::copy_n(d->cfrc_ext, 6 * m_->nbody, out);
  }

 private:
  int64_t ReportLength(bool has_forces) const {
    return 2 * m_->nq + m_->nv + (has_forces ? 12 : 6) * m_->nbody;
  }

  // Subtracts before it rounds: velocities would be lost far from the origin otherwise.
  static float* PutChange(const mjtNum* now, const mjtNum* before, int64_t count, float* out) {
    return std::transform(now, now + count, before, out, std::minus<mjtNum>());
  }

  const mjModel* m_;
  Words state_;
  Floats report_;
  bool has_forces_;
};

// As Gymnasium's reset: a new simulation with these positions and velocities.
ffi::Error Reset(int64_t id, Floats qpos, Floats qvel, ffi::Result<Words> state,
                 ffi::Result<Floats> report) {
  Workspace& workspace = WorkspaceOf(id);
  const mjModel* m = workspace.model;
  mjData* d = workspace.data.get();
  if (m == nullptr) return Unknown(id);
  Results results(m, *state, *report);
  ffi::Error error = Check({{"qpos", qpos.dimensions(), m->nq},
                            {"qvel", qvel.dimensions(), m->nv},
                            results.state(),
                            results.report()});
  if (!error.success()) return error;
  DefaultFloatingPoint scope;
  for (int64_t b = 0; b < BatchSize(qpos.dimensions()); ++b) {
    mj_resetData(m, d);
    std::copy_n(qpos.typed_data() + b * m->nq, m->nq, d->qpos);
    std::copy_n(qvel.typed_data() + b * m->nv, m->nv, d->qvel);
    Silence(d);
    mj_forward(m, d);
    results.Write(b, d, d->qpos, d->xpos);
  }
  return ffi::Error::Success();
}

// As Gymnasium's `do_simulation`: some of MuJoCo's steps with the same controls.
ffi::Error Step(int64_t id, int64_t frame_skip, Words state, Floats ctrl, ffi::Result<Words> next,
                ffi::Result<Floats> report) {
  Workspace& workspace = WorkspaceOf(id);
  const mjModel* m = workspace.model;
  mjData* d = workspace.data.get();
  if (m == nullptr) return Unknown(id);
  Results results(m, *next, *report);
  ffi::Error error = Check({{"state", state.dimensions(), 2 * Length(m)},
                            {"ctrl", ctrl.dimensions(), m->nu},
                            results.state(),
                            results.report()});
  if (!error.success()) return error;
  if (frame_skip < 1) return ffi::Error::InvalidArgument("frame_skip must be at least 1");
  DefaultFloatingPoint scope;
  const int qpos_offset = mj_stateSize(m, mjSTATE_TIME);  // the time is first and qpos next
  const int xpos_offset = mj_stateSize(m, kState);
  for (int64_t b = 0; b < BatchSize(state.dimensions()); ++b) {
    // XLA aligns arrays for doubles and more, and each element of the batch has whole doubles.
    const mjtNum* before = reinterpret_cast<const mjtNum*>(state.typed_data()) + b * Length(m);
    mj_setState(m, d, before, kState);
    const float* control = ctrl.typed_data() + b * m->nu;
    std::copy_n(control, m->nu, d->ctrl);
    for (int64_t i = 0; i < frame_skip; ++i) {
      Silence(d);  // again, as a simulation that begins anew forgets its counts
      mj_step(m, d);
    }
    if (results.has_forces()) mj_rnePostConstraint(m, d);
    results.Write(b, d, before + qpos_offset, before + xpos_offset);
  }
  return ffi::Error::Success();
}

}  // namespace

// Keeps a copy of a model under a number, unless the number already has a model.
extern "C" void SejaxMujocoRegister(int64_t id, const mjModel* model) {
  Models& all = AllModels();
  std::unique_lock lock(all.mutex);
  if (all.by_id.find(id) == all.by_id.end()) all.by_id[id] = mj_copyModel(nullptr, model);
}

// Doubles in a state of this model.
extern "C" int64_t SejaxMujocoLength(const mjModel* model) { return Length(model); }

// clang-format off
XLA_FFI_DEFINE_HANDLER_SYMBOL(
    SejaxMujocoReset, Reset,
    ffi::Ffi::Bind().Attr<int64_t>("model")
        .Arg<Floats>().Arg<Floats>().Ret<Words>().Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(
    SejaxMujocoStep, Step,
    ffi::Ffi::Bind().Attr<int64_t>("model").Attr<int64_t>("frame_skip")
        .Arg<Words>().Arg<Floats>().Ret<Words>().Ret<Floats>());
