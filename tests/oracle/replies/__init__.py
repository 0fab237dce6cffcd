"""What the program replied before its store was rebuilt, so that later versions are held to it.

`worlds` makes folders of bags, the same ones each time; `calls` draws what is asked of each;
`asking` answers a call, through the dispatcher, the page's routes or the command line; `fixture`
keeps calls and replies in tests/data/replies; `comparison` tells which differences matter.

    python -m tests.oracle.replies record [--world NAME] [--long]
    python -m tests.oracle.replies compare [--world NAME] [--long] [--store]

`record` is run where the replies are right, and its result committed; `compare` prints each
difference and exits with 1 where there is any. Where today's reply is known to be wrong,
`comparison.KNOWN_WRONG` says so, and brute force (`tests.oracle.truth`) is the judge instead.
"""
