# Every specifier of directions.
ego = new Object at 0 @ 0, facing Range(0, 360) deg, with width 2, with length 4
a = new Object ahead of ego by Range(1, 3)
b = new Object behind ego by Range(1, 3) @ Range(1, 3)
c = new Object left of ego by 2, facing Range(-30, 30) deg
d = new Object right of ego by Range(1, 5)
e = new Object beyond a by Range(2, 4) from ego
f = new Object offset by 0 @ Range(20, 25)
g = new Object offset along Range(0, 90) deg by 0 @ Range(-25, -20)
