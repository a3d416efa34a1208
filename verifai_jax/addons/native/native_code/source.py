"""The C++ of a whole program: it takes rows of inputs, and gives rows of packed results.

source = translate(program)                         # a closed program of one simulation
"""

from pathlib import Path

import numpy as np

from verifai_jax.addons.native.native_code import arrays as arrays
from verifai_jax.addons.native.native_code import control_flow as control_flow
from verifai_jax.addons.native.native_code import indexing as indexing
from verifai_jax.addons.native.native_code import randomness as randomness
from verifai_jax.addons.native.native_code import sums as sums
from verifai_jax.addons.native.native_code import values
from verifai_jax.addons.native.native_code.translation import Translator
from verifai_jax.core.compute.fingerprint import without_unused

PRELUDE = Path(__file__).with_name("prelude.hpp").read_text()
"""The beginning of every program."""
OTHERS = 255
"""Threads of a batch at most, but for the one that calls."""
CACHE = 2**18
"""Bytes of a core's cache that the arrays of a block should fit into."""


def translate(program: values.Program) -> str:
    """Translate a program of one simulation.

    **Arguments:**
    - `program`: a closed `Jaxpr` of the row `[d]`, the words `[2]` of a random key, the number of
      the simulation, a temperature, and shared numbers `[n]`; it returns a vector of bits.
    **Raises:** `Untranslatable` for a program with an unknown part.
    """
    used = without_unused(program.jaxpr, [True] * len(program.jaxpr.outvars))
    t = Translator()
    rows, _, _, _, numbers = used.invars
    if [values.kind_of(each.aval.dtype) for each in used.invars] != ["f", "u", "i", "f", "f"]:
        raise values.Untranslatable("a program of other inputs")
    d = rows.aval.shape[0]
    row = np.empty(d, object)
    for i in range(d):
        row[i] = t.code.define(f"column(rows + {i}, {d}, at + k * W, end)", "f", False)
    words = np.empty(2, object)
    words[:] = [values.Element(f"key[{i}]", "u", True) for i in range(2)]
    number = t.code.define("first + (int)(at + k * W) + lanes()", "i", False)
    temperature = t.code.define("column(temperatures, 1, at + k * W, end)", "f", False)
    shared = values.Memory("numbers", "f", True, numbers.aval.shape)
    results = t.program(used, program.consts, [row, words, one(number), one(temperature), shared])
    (packed,) = results
    for i, each in enumerate(values.elements(packed)):
        text = f"wide({each.text})" if each.uniform else each.text
        t.line(f"give({text}, out + {i} * total, at + k * W, end);")
    lines, arena = t.code.body()
    vectors = next((k for k in (4, 2) if arena * k * 64 <= CACHE * (4 // k)), 1)
    body = "\n".join(lines)
    function = _FUNCTION.replace("@arena", str(arena)).replace("@others", str(OTHERS))
    function = function.replace("@body", body)
    # Before any macro, which a header of the system may have as a name.
    head = f"#include <pthread.h>\n#define K {vectors}\nenum {{ PAIR = {min(vectors, 2)} }};"
    return "\n".join([head, PRELUDE, _HEAD, *t.code.globals, function])


def one(element: values.Element) -> np.ndarray:
    """Return an array without axes."""
    out = np.empty((), object)
    out[()] = element
    return out


_HEAD = r"""
extern "C" int posix_memalign(void **, __SIZE_TYPE__, __SIZE_TYPE__);
extern "C" void free(void *);
INLINE F column(const float *from, long step, long at, long end) {
  F r;
  if (__builtin_expect(at + W <= end, 1)) {
    for (int l = 0; l < W; l++) r[l] = from[(at + l) * step];
  } else {
    for (int l = 0; l < W; l++) r[l] = from[(at + l < end ? at + l : end - 1) * step];
  }
  return r;
}
INLINE I lanes() { I r; for (int l = 0; l < W; l++) r[l] = l; return r; }
INLINE void give(U bits, unsigned *to, long at, long end) {
  if (__builtin_expect(at + W <= end, 1)) __builtin_memcpy(to + at, &bits, sizeof(U));
  else for (int l = 0; at + l < end; l++) to[at + l] = bits[l];
}
"""
_FUNCTION = r"""
extern "C" int width() { return K * W; }
/* Rows `begin` to `end` of a total; each result in a row of its own. 1: there is no memory. */
static int part(const float *rows, const unsigned *key, int first, const float *temperatures,
                const float *numbers, long begin, long end, long total, unsigned *out) {
  F *arena = 0;
  if (@arena && posix_memalign((void **)&arena, 64, (long)K * @arena * sizeof(F))) return 1;
#if defined(__x86_64__)
  /* As XLA does: numbers too small to be normal are zero. */
  unsigned mode = __builtin_ia32_stmxcsr();
  __builtin_ia32_ldmxcsr(mode | 0x8040);
#endif
  for (long at = begin; at < end; at += K * W) {
@body
  }
#if defined(__x86_64__)
  __builtin_ia32_ldmxcsr(mode);
#endif
  free(arena);
  return 0;
}
struct Batch {
  const float *rows; const unsigned *key; int first; const float *temperatures, *numbers;
  long total, size, next; unsigned *out; int failed; };
static void *take_parts(void *of) {
  Batch *b = (Batch *)of;
  for (long begin; (begin = __atomic_fetch_add(&b->next, b->size, __ATOMIC_RELAXED)) < b->total;) {
    long end = begin + b->size < b->total ? begin + b->size : b->total;
    if (part(b->rows, b->key, b->first, b->temperatures, b->numbers, begin, end, b->total, b->out))
      __atomic_store_n(&b->failed, 1, __ATOMIC_RELAXED);
  }
  return 0; }
/* All rows, in parts of this size, by this thread and by so many others. */
extern "C" int run(const float *rows, const unsigned *key, int first, const float *temperatures,
                   const float *numbers, long total, long size, int others, unsigned *out) {
  Batch batch = {rows, key, first, temperatures, numbers, total, size, 0, out, 0};
  pthread_t threads[@others];
  pthread_attr_t attributes;
  int count = 0;
  if (others > 0 && !pthread_attr_init(&attributes)) {
    pthread_attr_setstacksize(&attributes, 1 << 24);
    while (count < others && !pthread_create(&threads[count], &attributes, take_parts, &batch))
      count++;
    pthread_attr_destroy(&attributes);
  }
  take_parts(&batch);
  while (count) pthread_join(threads[--count], 0);
  return batch.failed;
}
"""
