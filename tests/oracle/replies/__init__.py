"""What the program replied before its store was rebuilt, so that later versions are held to it.

`worlds` makes folders of bags, the same ones each time; `asking` answers a call, through the
dispatcher, the page's routes or the command line; `fixture` keeps calls, which were drawn from what
the topics of each world are, and replies in tests/data/replies; `comparison` tells which
differences matter. Where replies are right, record them and commit the result:

    UPDATE_REPLIES=1 EPISODIC_LONG=1 uv run pytest -n0 --no-cov tests/oracle/test_replies.py -k bags
"""
