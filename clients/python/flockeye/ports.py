"""Publishers and subscribers of the contract's topics."""

import ctypes

import iceoryx2 as iox2


class Message:
    """One message in shared memory."""

    def __init__(self, sample, item):
        self._sample = sample
        self._is_kept = False
        # Not payload().len(): version 0.10.0 of the bindings counts bytes there.
        count = sample.header.number_of_elements
        self.header = sample.user_header().contents
        self.items = (item * count).from_address(sample.payload_ptr)

    def pixels(self):
        """The payload's bytes, not copied. Read-only: others read the same memory."""
        return memoryview(self.items).cast("B").toreadonly()

    def keep(self):
        """Keeps the message until `release`. The contract says how many a reader may keep."""
        self._is_kept = True
        return self

    def release(self):
        """Gives the memory back; header and items must not be used any more."""
        if self._sample is not None:
            self._sample.delete()
            self._sample = None

    def _read(self):
        if not self._is_kept:
            self.release()


class Subscriber:
    """Receives a topic."""

    def __init__(self, port, listener, topic, listening):
        self.port, self.listener, self.topic = port, listener, topic
        self._listening = listening

    def waiting(self):
        """Everything that waits, oldest first. Each message is valid until the next one is asked for. Messages of
        a process that does not count while a stage is swapped are left out."""
        while (sample := self.port.receive()) is not None:
            message = Message(sample, self.topic.item)
            try:
                if self._listening is None or self._listening.admits(message.header):
                    yield message
            finally:
                message._read()

    def newest(self):
        """The newest message that waits, kept until its `release`; None if nothing waits."""
        newest = None
        for message in self.waiting():
            if newest is not None:
                newest.release()
            newest = message.keep()
        return newest

    def drain_events(self):
        """Takes the events that have woken this process."""
        self.listener.try_wait()


class Loan:
    """Memory for one message, to be filled in place."""

    def __init__(self, sample, topic, count):
        self._sample = sample
        self.header = topic.header.from_address(ctypes.addressof(sample.user_header().contents))
        self.items = (topic.item * count).from_address(sample.payload_ptr)
        ctypes.memset(ctypes.addressof(self.header), 0, ctypes.sizeof(topic.header))

    def pixels(self):
        """The payload's bytes, to be written."""
        return memoryview(self.items).cast("B")


class Publisher:
    """Publishes a topic, and wakes its subscribers."""

    def __init__(self, port, notifier, service, topic):
        self.port, self.notifier, self.topic = port, notifier, topic
        self._service = service

    def loan(self, count):
        """Memory for a message of `count` items. It is sent at the end of the `with` block, if that ends without
        an exception."""
        return _Loaning(self, count)

    def send(self, header, items=()):
        """Sends a copy of `header` and `items`."""
        with self.loan(len(items)) as loan:
            ctypes.memmove(ctypes.addressof(loan.header), ctypes.addressof(header), ctypes.sizeof(header))
            for index, item in enumerate(items):
                loan.items[index] = item

    def is_heard(self):
        """Whether anybody subscribes to the topic."""
        return self._service.dynamic_config.number_of_subscribers > 0

    def update_connections(self):
        """Hands the history to whoever has subscribed since the last message."""
        self.port.update_connections()


class _Loaning:
    def __init__(self, publisher, count):
        self._publisher, self._count = publisher, count

    def __enter__(self):
        self._sample = self._publisher.port.loan_slice_uninit(self._count)
        return Loan(self._sample, self._publisher.topic, self._count)

    def __exit__(self, kind, *_):
        if kind is not None:
            self._sample.delete()
            return
        self._sample.assume_init().send()
        self._publisher.notifier.notify()


class Waker:
    """Waits for several topics at once."""

    def __init__(self, subscribers):
        self._subscribers = subscribers
        builder = iox2.WaitSetBuilder.new().signal_handling_mode(iox2.SignalHandlingMode.Disabled)
        self._waitset = builder.create(iox2.ServiceType.Ipc)
        self._guards = [self._waitset.attach_notification(each.listener) for each in subscribers]

    def wait(self, seconds):
        """Returns when something was published on one of the topics, or after so many seconds."""
        if seconds > 0:
            self._waitset.wait_and_process_with_timeout(iox2.Duration.from_secs_f64(seconds))
        for subscriber in self._subscribers:
            subscriber.drain_events()

    def close(self):
        """Ends the waiting, before the subscribers end."""
        for guard in self._guards:
            guard.delete()
        self._waitset.delete()


def wait_any(subscribers, seconds):
    """Waits until something was published on one of the topics, or for so many seconds. A loop had better keep a
    `Waker`."""
    waker = Waker(subscribers)
    waker.wait(seconds)
    waker.close()
