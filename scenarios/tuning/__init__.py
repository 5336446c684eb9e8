"""Gains by structured H-infinity synthesis, as chapter 7 of the study makes them (`froude tune`).

Read `requirements`, then `weights` made of them, `channels` (what the weights shape), `synthesis` (the search),
`certificate` (what is proven of the result), `tuned_set` (what is written and shown).
"""
