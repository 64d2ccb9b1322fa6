"""The process of ``CzCrystal-v0``: a whole crystal, crown, body and tail, along a recipe that runs with its length."""
