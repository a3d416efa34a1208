# Ranges whose ends are random.
low = Range(1, 3)
high = low + Range(2, 4)
ego = new Object at 0 @ 0
other = new Object at Range(low, high) @ Range(5, high + 5), facing Range(-low, low) deg
param wide = Range(low, 10)
