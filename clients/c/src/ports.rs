//! Subscribers and publishers of any topic, by name.
//!
//! In Rust each topic has types of its own. In C a message is a header and items in memory.
//! `contract.h` gives their types for each topic name.

use std::any::Any;
use std::ffi::{c_char, c_int, c_void};

use anyhow::{Context, bail};
use flockeye_contract::{TOPICS, Topic, TopicVisitor, visit_topics};
use flockeye_runtime::ports::{Loan, Message, PortError, Ports, Publisher, Subscriber};

use crate::failure::{self, NOTHING, OK};
use crate::stage::{FlockeyeStage, text_of};

/// `flockeye_message` in C.
#[repr(C)]
pub struct FlockeyeMessage {
    header: *const c_void,
    items: *const c_void,
    count: usize,
    /// A boxed `Box<dyn Any>`; null once it is released.
    owner: *mut c_void,
}

/// `flockeye_loan` in C.
#[repr(C)]
pub struct FlockeyeLoan {
    items: *mut c_void,
    count: usize,
    /// A boxed `Box<dyn Any>`; null once it is sent or dropped.
    owner: *mut c_void,
}

/// A subscriber of any topic. The function returns the next message.
pub struct FlockeyeSubscriber(Box<dyn FnMut() -> Result<Option<FlockeyeMessage>, PortError>>);

/// A publisher of any topic.
pub struct FlockeyePublisher(Box<dyn AnyPublisher>);

/// Receives the next message of a topic in the form for C.
fn receive<T: Topic + 'static>(
    subscriber: &mut Subscriber<T>,
) -> Result<Option<FlockeyeMessage>, PortError> {
    Ok(subscriber.receive()?.map(|message| {
        let (items, count) = (message.items().as_ptr().cast(), message.items().len());
        // The header has a box of its own. Nothing moves or borrows it until C releases it.
        let header = Box::into_raw(Box::new(message.header));
        let owner = into_owner(Box::new(Kept::<T> { header, _message: message }));
        FlockeyeMessage { header: header.cast(), items, count, owner }
    }))
}

/// A message that C holds, with a copy of its header.
struct Kept<T: Topic> {
    header: *mut T::Header,
    _message: Message<T>,
}

impl<T: Topic> Drop for Kept<T> {
    fn drop(&mut self) {
        // SAFETY: the pointer is from `Box::into_raw` in `receive`, and only this value frees it.
        drop(unsafe { Box::from_raw(self.header) });
    }
}

impl FlockeyeMessage {
    const NONE: Self = Self {
        header: std::ptr::null(),
        items: std::ptr::null(),
        count: 0,
        owner: std::ptr::null_mut(),
    };
}

impl FlockeyeLoan {
    const NONE: Self = Self { items: std::ptr::null_mut(), count: 0, owner: std::ptr::null_mut() };
}

trait AnyPublisher {
    fn loan(&self, count: usize) -> Result<FlockeyeLoan, PortError>;
    /// # Safety
    /// `header` points to this topic's header.
    unsafe fn send(&self, loan: Box<dyn Any>, header: *const c_void) -> anyhow::Result<()>;
    fn update_connections(&self) -> Result<(), PortError>;
    fn item_bytes(&self) -> usize;
}

impl<T: Topic + 'static> AnyPublisher for Publisher<T> {
    fn loan(&self, count: usize) -> Result<FlockeyeLoan, PortError> {
        let mut loan = Publisher::loan(self, count)?;
        let items = loan.items_mut().as_mut_ptr().cast();
        Ok(FlockeyeLoan { items, count, owner: into_owner(Box::new(loan)) })
    }

    unsafe fn send(&self, loan: Box<dyn Any>, header: *const c_void) -> anyhow::Result<()> {
        let Ok(loan) = loan.downcast::<Loan<T>>() else {
            bail!("the loan is of another topic than {}", T::NAME)
        };
        // SAFETY: the caller's promise; any bytes are a valid header.
        let header = unsafe { header.cast::<T::Header>().read_unaligned() };
        Ok(self.send_loan(*loan, header)?)
    }

    fn update_connections(&self) -> Result<(), PortError> {
        Publisher::update_connections(self)
    }

    fn item_bytes(&self) -> usize {
        size_of::<T::Item>()
    }
}

fn into_owner(value: Box<dyn Any>) -> *mut c_void {
    Box::into_raw(Box::new(value)).cast()
}

/// # Safety
/// `owner` is null or from [`into_owner`], and is not used any more.
unsafe fn from_owner(owner: *mut c_void) -> Option<Box<dyn Any>> {
    // SAFETY: the caller's promise.
    (!owner.is_null()).then(|| *unsafe { Box::from_raw(owner.cast::<Box<dyn Any>>()) })
}

/// A port of any topic.
trait AnyPort: Sized {
    /// Opens the port for topic `T`.
    fn open<T: Topic + 'static>(ports: &mut Ports, lane: usize) -> Result<Self, PortError>;
}

impl AnyPort for FlockeyeSubscriber {
    fn open<T: Topic + 'static>(ports: &mut Ports, lane: usize) -> Result<Self, PortError> {
        let mut subscriber = ports.subscriber_of_lane::<T>(lane)?;
        Ok(Self(Box::new(move || receive(&mut subscriber))))
    }
}

impl AnyPort for FlockeyePublisher {
    fn open<T: Topic + 'static>(ports: &mut Ports, lane: usize) -> Result<Self, PortError> {
        Ok(Self(Box::new(ports.publisher_of_lane::<T>(lane)?)))
    }
}

/// A visitor of all topics. It opens the port of the topic with this name.
struct PortOpening<'a, P> {
    ports: &'a mut Ports,
    topic: &'a str,
    lane: usize,
    opened: Option<P>,
}

impl<P: AnyPort> TopicVisitor for PortOpening<'_, P> {
    type Error = PortError;

    fn visit<T: Topic + 'static>(&mut self) -> Result<(), PortError> {
        if T::NAME == self.topic {
            self.opened = Some(P::open::<T>(self.ports, self.lane)?);
        }
        Ok(())
    }
}

/// # Safety
/// `stage` and `topic` are as the header requires.
unsafe fn open<P: AnyPort>(
    stage: *mut FlockeyeStage,
    topic: *const c_char,
    lane: u32,
) -> anyhow::Result<P> {
    // SAFETY: the caller's promise.
    let (topic, ports) = unsafe { (text_of(topic)?, FlockeyeStage::ports(stage)?) };
    let mut opening = PortOpening { ports, topic, lane: lane as usize, opened: None };
    visit_topics(&mut opening)?;
    opening.opened.with_context(|| {
        let names: Vec<_> = TOPICS.iter().map(|topic| topic.name).collect();
        format!("there is no topic '{topic}'. Topics: {}", names.join(", "))
    })
}

/// Receives a topic; see `stage.h`.
///
/// # Safety
/// `stage` is open, and `topic` a string.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_subscribe(
    stage: *mut FlockeyeStage,
    topic: *const c_char,
    lane: u32,
) -> *mut FlockeyeSubscriber {
    // SAFETY: the caller's promise.
    failure::handle(unsafe { open(stage, topic, lane) })
}

/// Publishes a topic; see `stage.h`.
///
/// # Safety
/// As [`flockeye_subscribe`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_advertise(
    stage: *mut FlockeyeStage,
    topic: *const c_char,
    lane: u32,
) -> *mut FlockeyePublisher {
    // SAFETY: the caller's promise.
    failure::handle(unsafe { open(stage, topic, lane) })
}

/// Ends a subscriber. Messages that were kept stay valid.
///
/// # Safety
/// `subscriber` is null or open, and is not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_subscriber_close(subscriber: *mut FlockeyeSubscriber) {
    if !subscriber.is_null() {
        // SAFETY: the caller's promise; the pointer is from `flockeye_subscribe`.
        drop(unsafe { Box::from_raw(subscriber) });
    }
}

/// Ends a publisher.
///
/// # Safety
/// `publisher` is null or open, and neither it nor a loan of it is used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_publisher_close(publisher: *mut FlockeyePublisher) {
    if !publisher.is_null() {
        // SAFETY: the caller's promise; the pointer is from `flockeye_advertise`.
        drop(unsafe { Box::from_raw(publisher) });
    }
}

/// Receives the next waiting message; see `stage.h`.
///
/// # Safety
/// `subscriber` is open, and `message` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_receive(
    subscriber: *mut FlockeyeSubscriber,
    message: *mut FlockeyeMessage,
) -> c_int {
    // SAFETY: the caller's promise.
    let subscriber = unsafe { &mut *subscriber };
    // SAFETY: the caller's promise. Releasing an empty message has no effect.
    unsafe { message.write(FlockeyeMessage::NONE) };
    failure::code((subscriber.0)().map_err(Into::into).map(|received| match received {
        Some(received) => {
            // SAFETY: the caller's promise.
            unsafe { message.write(received) };
            OK
        }
        None => NOTHING,
    }))
}

/// Releases the memory of a message.
///
/// # Safety
/// `message` is from [`flockeye_receive`] or was released before. Its header and items are not used
/// any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_release(message: *mut FlockeyeMessage) {
    // SAFETY: the caller's promise.
    let released = unsafe { std::ptr::replace(message, FlockeyeMessage::NONE) };
    // SAFETY: the pointer is from `flockeye_receive`, or null.
    drop(unsafe { from_owner(released.owner) });
}

/// Loans memory for a message; see `stage.h`.
///
/// # Safety
/// `publisher` is open, and `loan` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_loan_items(
    publisher: *const FlockeyePublisher,
    count: usize,
    loan: *mut FlockeyeLoan,
) -> c_int {
    // SAFETY: the caller's promise.
    let publisher = unsafe { &*publisher };
    // SAFETY: the caller's promise. Dropping an empty loan has no effect.
    unsafe { loan.write(FlockeyeLoan::NONE) };
    failure::code(publisher.0.loan(count).map_err(Into::into).map(|lent| {
        // SAFETY: the caller's promise.
        unsafe { loan.write(lent) };
        OK
    }))
}

/// Sends a loan under this header; see `stage.h`.
///
/// # Safety
/// `publisher` is open, `loan` is from [`flockeye_loan_items`], and `header` points to the topic's
/// header.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_send_loan(
    publisher: *const FlockeyePublisher,
    loan: *mut FlockeyeLoan,
    header: *const c_void,
) -> c_int {
    // SAFETY: the caller's promise.
    let publisher = unsafe { &*publisher };
    // SAFETY: the caller's promise.
    let lent = unsafe { std::ptr::replace(loan, FlockeyeLoan::NONE) };
    // SAFETY: the caller's promise.
    let unsent = unsafe { from_owner(lent.owner) }.context("the loan was sent or dropped before");
    // SAFETY: the caller's promise.
    failure::code(
        unsent.and_then(|unsent| unsafe { publisher.0.send(unsent, header) }).map(|()| OK),
    )
}

/// Drops a loan without sending it.
///
/// # Safety
/// `loan` is from [`flockeye_loan_items`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_drop_loan(loan: *mut FlockeyeLoan) {
    // SAFETY: the caller's promise.
    let dropped = unsafe { std::ptr::replace(loan, FlockeyeLoan::NONE) };
    // SAFETY: the pointer is from `flockeye_loan_items`, or null.
    drop(unsafe { from_owner(dropped.owner) });
}

/// Sends a copy of header and items; see `stage.h`.
///
/// # Safety
/// `publisher` is open, `header` points to the topic's header, and `items` to `count` of its items.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_send(
    publisher: *const FlockeyePublisher,
    header: *const c_void,
    items: *const c_void,
    count: usize,
) -> c_int {
    // SAFETY: the caller's promise.
    let publisher = unsafe { &*publisher };
    let sent = publisher.0.loan(count).map_err(anyhow::Error::from).and_then(|loan| {
        if count > 0 {
            let bytes = count * publisher.0.item_bytes();
            // SAFETY: the loan has room for `count` items. The caller's items do not overlap with
            // it.
            unsafe { std::ptr::copy_nonoverlapping(items.cast::<u8>(), loan.items.cast(), bytes) };
        }
        // SAFETY: the loan is new, and no other code has its pointer.
        let unsent = unsafe { from_owner(loan.owner) }.context("a new loan has its memory")?;
        // SAFETY: the caller's promise.
        unsafe { publisher.0.send(unsent, header) }
    });
    failure::code(sent.map(|()| OK))
}

/// Sends the kept messages of the topic to late subscribers; see `stage.h`.
///
/// # Safety
/// `publisher` is open.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_update_connections(publisher: *const FlockeyePublisher) -> c_int {
    // SAFETY: the caller's promise.
    let updated = unsafe { &*publisher }.0.update_connections();
    failure::code(updated.map(|()| OK).map_err(Into::into))
}
