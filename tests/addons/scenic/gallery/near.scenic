# A view all around that ends: what is too far is refused.
ego = new Object at Range(-5, 5) @ Range(-5, 5), with visibleDistance 9, with width 2, with length 4,
    facing Range(0, 360) deg
other = new Object at Range(-15, 15) @ Range(-15, 15), with width 2, with length 3,
    facing Range(0, 360) deg
