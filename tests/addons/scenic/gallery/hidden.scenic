# Views: a narrow one, a short one, and one that a lorry hides.
ego = new Object at 0 @ 0, facing Range(-20, 20) deg, with viewAngle 60 deg, with visibleDistance 30
sign = new Object at Range(-8, 8) @ Range(5, 20), with width 0.5, with length 0.5
lorry = new Object at Range(-20, 20) @ Range(24, 40), with width 3, with length 8, with requireVisible False
