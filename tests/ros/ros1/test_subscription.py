"""Whom a subscription follows; what goes over its connections is looked at in `test_node`, on a real graph."""

import asyncio

from skytether.ros.ros1.subscription import Subscription


def test_whoever_names_thousands_of_publishers_is_not_followed_to_all_of_them():
    asked = {}

    async def run():
        def ask(function):
            asked[function.args[0]] = asyncio.get_running_loop().create_future()
            return asked[function.args[0]]

        subscription = Subscription("/own", "http://own/", "/scan", "*", "", ask)
        subscription.update(["http://own/", "http://laser/"])
        await asyncio.sleep(0)
        subscription.update([f"http://made-up-{n}/" for n in range(3000)] + ["http://laser/"])
        for _ in range(3):
            await asyncio.sleep(0)
        assert not asked["http://laser/"].cancelled(), "whom it follows already it goes on to follow"
        subscription.close()
        await asyncio.sleep(0)

    asyncio.run(run())
    assert next(iter(asked)) == "http://laser/"
    assert len(asked) == 64
