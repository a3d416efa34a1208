"""Systems under test, one file each: dynamics, controllers, and how features enter them."""
