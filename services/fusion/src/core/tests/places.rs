//! Searches of places that look like a body.

use super::*;

/// A view of a place that looks like a body, without a marker that is decoded in it. It shows
/// alpha.
fn proposal(sequence: u64) -> ViewHeader {
    let view = ViewHeader { kind: ViewKind::Proposal.code(), ..region_view(sequence, 0) };
    // The field of a proposal's view says how far away the body is.
    let place = {
        let body = alpha();
        let in_sides = body.radius() / body.largest_side();
        crate::frame::places::place_of(&view_of(&view), body.largest_side(), in_sides)
    };
    let range_m = pose(0.9).translation.vector.norm();
    assert!((0.7..1.4).contains(&(place.range_m / range_m)), "{place:?} at {range_m} m");
    view
}

/// What is said of a frame with one such view.
fn said_of(core: &mut Core<Vec<u8>>, view: ViewHeader) -> Vec<Outputs> {
    let sequence = view.stamp.sequence;
    core.on(Event::View(view, shown().1.clone()), 0);
    core.on(Event::Searched(empty_record(sequence)), 0);
    core.on(frame_end(sequence, 0, 1), 0);
    let said = drain(core, 0);
    assert!(is_ended(&said));
    said
}

#[test]
fn a_body_without_a_decoded_marker_is_found_at_its_place() {
    let said = |searches: bool| {
        let mut core = core_with(Schedule::Unlimited, searches);
        drain(&mut core, 0);
        said_of(&mut core, proposal(0))
    };
    assert_eq!(poses(&said(true)), [0]);
    assert!(poses(&said(false)).is_empty(), "nothing else finds it");

    // A proposal without a place shows nothing that was chosen.
    let mut core = core_with(Schedule::Unlimited, true);
    drain(&mut core, 0);
    let search = flockeye_contract::Search::Nothing.code();
    assert!(poses(&said_of(&mut core, ViewHeader { search, ..proposal(0) })).is_empty());
}
