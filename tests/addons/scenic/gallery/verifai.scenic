# Parameters of VerifAI's samplers.
ego = new Object at VerifaiRange(-2, 2) @ 0
other = new Object at VerifaiRange(5, 15) @ VerifaiDiscreteRange(3, 7), with speed VerifaiRange(0, 10)
new Object at -10 @ Range(0, 5), with color VerifaiOptions(["red", "green", "blue"])
param verifaiSamplerType = "halton"
