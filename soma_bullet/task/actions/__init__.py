"""What hands can do: one file for each action.

Each file has the action itself, a frozen value with the joints that it takes, and the same four verbs:

- `candidates`: ways to do it that may be worth a look, best first;
- `check`: one of them with its lines free, as an action, or None with the refusal counted;
- `effects`: the state of the cell afterwards (of `Action`, by following the steps);
- `steps`: what it is made of, each a segment to be, in order.

A new action is a new file: a subclass of `Action`, with kinds of segments of its own if it needs some.
"""
