# Arithmetic of vectors, headings and tuples.
base = Range(1, 2) @ Range(3, 4)
ego = new Object at base * 2, facing Range(10, 40) deg
offset = base
other = new Object at ego offset by offset * 3, facing ego.heading / 2
speeds = [Range(1, 2), Range(3, 4)]
third = new Object at (ego.position + (10 @ 0)) offset by 0 @ speeds[0], with speed speeds[1] - speeds[0] * 2
param total = abs(speeds[0] - speeds[1]) % 1.5
