# Cars one behind the other, each with a gap of its own.
leader = new Object at Range(-1, 1) @ 0, with width 2, with length 4.5, with speed Range(10, 20)
previous = leader
for i in range(3):
    gap = Range(3, 12)
    previous = new Object behind previous by gap, with width 2, with length 4.5,
        with speed previous.speed + Range(-2, 2)
ego = previous
