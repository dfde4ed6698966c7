"""Two whole sessions over made-up links."""

from skytether.wire import Role

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE


def test_a_clean_link_delivers_everything_once_in_order(world):
    link = world.link()
    sent = {"scan": [], "camera": [], "log": []}

    def publish():
        for topic, size in (("scan", 2222), ("camera", 47_611), ("log", 60)):
            payload = world.random.randbytes(size)
            sent[topic].append(payload)
            assert link.publish(ROBOT, topic, payload)

    link.every(0.05, link.now + 2, publish)
    link.run(3)
    for topic, payloads in sent.items():
        assert [bytes(m.payload) for _, m in link.messages[SERVICE] if m.topic == topic] == payloads
    assert not link.sessions[SERVICE].stats(link.now).rejected
    assert not link.sessions[ROBOT].stats(link.now).rejected
