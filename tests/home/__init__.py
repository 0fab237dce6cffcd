"""A simulated home robot's days: its bags, the truth about them, and what an owner asks of them.

`flat` is the floor plan, `things` what stands where and when, `paths` how robot and people move,
`days` what happens on each day, `drift` the frames `map` and `odom`, `camera` the detector and its
mistakes, `recording` the bags, `truth` what an answer is judged by, `questions` the questions.

Inside, a moment is a count of seconds since the world began, on a clock that nobody sets. The
robot's own clock is set once (`World.clock`): all that is written, and all that the truth states,
is in Unix seconds of the robot's clock.
"""
