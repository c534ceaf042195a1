"""What single functions, operations of expressions and the parts of an exchange of tables cost: the second half of `bench.py`."""

from __future__ import annotations

from bench_stage import ACTIONS, MAPPINGS, PATIENCE_US, PLAYING, Cost, Stage, load, numbers, play

from marotte.mcu.raw_repl import RawRepl
from shared import formats, program

MEASURE_CALL = """
a = puppet.actions
t = puppet.tables
def evaluate():
    {call}
print(frames(evaluate))
"""

EVALUATE = (
    "functions.evaluate(a.playing, a.found, a.cycle, a.fraction_q24, t.first_mapping, t.mapping_count, t.function, t.argument, "
    "t.same, puppet._sine, puppet.gradients, puppet._live_w_q28, t.curve_start, t.curve_samples, t.samples_q15, "
    "puppet._value_q15)"
)
EVALUATE_PROGRAMS = (
    "puppet.programs.evaluate(t, a, puppet._sine, puppet.gradients, puppet._live_w_q28, puppet._value_q15)"
)
EVALUATE_BLINKS = "puppet.blinks.evaluate(t, a, puppet._sine, puppet._value_q15)"

FUNCTION_KINDS = {
    "a constant": (formats.FUNCTION_CONST, None, EVALUATE),
    "a live channel": (formats.FUNCTION_LIVE, 0, EVALUATE),
    "noise": (formats.FUNCTION_NOISE, None, EVALUATE),
    "a curve": (formats.FUNCTION_CURVE, None, EVALUATE),
    "a blink": (formats.FUNCTION_BLINK, None, EVALUATE_BLINKS),
}

HALF_Q16 = 1 << 15
OPERATIONS = {
    "constant, add": (program.CONST, HALF_Q16, program.ADD),
    "constant, subtract": (program.CONST, HALF_Q16, program.SUB),
    "constant, multiply": (program.CONST, HALF_Q16, program.MUL),
    "constant, min": (program.CONST, HALF_Q16, program.MIN),
    "scale": (program.SCALE, 90000, 16),
    "negate": (program.NEG,),
    "absolute": (program.ABS,),
    "two constants, clamp": (program.CONST, 0, program.CONST, HALF_Q16, program.CLAMP),
    "two constants, lerp": (program.CONST, HALF_Q16, program.CONST, HALF_Q16, program.LERP),
    "rsin, add": (program.RSIN, 32, 1 << 22, program.ADD),
    "noise, add": (program.NOISE, 3, 8, 0, 0, program.ADD),
    "curve, add": (program.CURVE, 0, 16, 0, program.ADD),
    "live, add": (program.LIVE, 0, program.ADD),
}
"""Words that leave the stack as high as they find it."""
FEW, MANY = 2, 8
"""How often the words are repeated in the two programs whose difference is their cost."""

MEASURE_EXCHANGE = """
for place in range(staged.actions):
    staged.keep_action[place] = place
for place in range(staged.dofs):
    staged.keep_dof[place] = place
staged.keep_live[0] = 0
staged.seed = {seed}
times = []
gc.collect()
for call in (gc.collect, staged.missing, staged.doubled):
    begun = time.ticks_us()
    call()
    times.append(time.ticks_diff(time.ticks_us(), begun))
puppet.exchange.begin()
done = False
steps = []
while not done:
    begun = time.ticks_us()
    done = puppet.exchange.prepare()
    steps.append(time.ticks_diff(time.ticks_us(), begun))
begun = time.ticks_us()
puppet.exchange.carry_over()
times.append(time.ticks_diff(time.ticks_us(), begun))
print(times)
print(steps)
staged = puppet.staged
"""


def measure_functions(repl: RawRepl) -> list[Cost]:
    """Measure one evaluation of each kind of function, and of each operation of a program, `PLAYING * MAPPINGS` at a time."""
    evaluations = PLAYING * MAPPINGS

    def times_us(stage: Stage, call: str) -> list[float]:
        play(repl, stage)
        (times,) = numbers(repl.exec(MEASURE_CALL.format(call=call), PATIENCE_US))
        return [time_us / evaluations for time_us in times]

    costs = []
    for name, (code, argument, call) in FUNCTION_KINDS.items():
        costs.append(Cost.of(name, times_us(Stage(PLAYING, [(code, argument)]), call)))
    programs = [(formats.FUNCTION_PROGRAM, None)]
    costs.append(Cost.of("a program: constants, add", times_us(Stage(PLAYING, programs), EVALUATE_PROGRAMS)))
    for name, words in OPERATIONS.items():
        few, many = (
            times_us(Stage(PLAYING, programs, [program.CONST, HALF_Q16, *count * words]), EVALUATE_PROGRAMS)
            for count in (FEW, MANY)
        )
        each = [(more - less) / (MANY - FEW) for less, more in zip(few, many, strict=True)]
        costs.append(Cost.of("  in it: " + name, each))
    return costs


def measure_exchange(repl: RawRepl) -> list[Cost]:
    """Measure the parts of an exchange of the whole stage for itself, with another seed and with the same."""
    costs = []
    for seed, steps_name in ((7, "a step, another seed"), (7, "a step, the same seed")):
        if not costs:
            play(repl, Stage(ACTIONS))
        load(repl, Stage(ACTIONS))
        parts, steps = numbers(repl.exec(MEASURE_EXCHANGE.format(seed=seed), PATIENCE_US))
        if not costs:
            names = (
                "collecting the heap",
                "looking for what is missing",
                "looking for what is double",
                "carrying over",
            )
            costs += [Cost.of(name, [time_us]) for name, time_us in zip(names, parts, strict=True)]
        costs.append(Cost.of(steps_name, steps))
    return costs
