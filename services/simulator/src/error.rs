//! Errors of a world, and of the rendering of a frame.

/// An error in the definition of a world.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the texts name the fields")]
pub enum WorldError {
    /// Values out of range; the texts name all of them.
    #[error("{}", .0.join("; "))]
    Parameters(Vec<String>),
    /// A marker that the dictionary does not have.
    #[error(
        "marker {id} of body '{body}' is not in {dictionary}, which has ids 0 to {last}; choose \
         another id, or a larger dictionary"
    )]
    UnknownMarker { body: String, id: u32, dictionary: String, last: usize },
    /// A dictionary that is not the bodies' dictionary.
    #[error("the bodies' markers are from {bodies}, not from {given}; load {bodies}")]
    Dictionary { bodies: String, given: String },
    /// A body whose facets are not all on the surface of their hull.
    #[error(
        "{} does not lie on the body's convex hull; only convex bodies can be simulated",
        described(.body, .marker)
    )]
    NotConvex { body: String, marker: Option<u32> },
    /// A distance range that starts inside a drone.
    #[error(
        "body '{body}' comes as near as {near} m, and must stay {least:.2} m away; raise distance_m's first value"
    )]
    TooNear { body: String, near: f64, least: f64 },
    /// Too many bodies to fly without collisions.
    #[error(
        "{bodies} bodies cannot keep apart between {near} m and {far} m; raise distance_m, or simulate fewer bodies"
    )]
    Crowded { bodies: usize, near: f64, far: f64 },
}

fn described(body: &str, marker: &Option<u32>) -> String {
    match marker {
        Some(id) => format!("marker {id} of body '{body}'"),
        None => format!("a blank facet of body '{body}'"),
    }
}

/// An error in the rendering of a frame.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the texts name the fields")]
pub enum RenderError {
    /// Rows that overlap.
    #[error("a stride of {stride} bytes is shorter than a row of {width} pixels")]
    Stride { stride: usize, width: usize },
    /// Memory that is smaller than the picture.
    #[error("the frame needs {needed} bytes; the memory given has {given}")]
    Memory { needed: usize, given: usize },
    /// A moment with another number of bodies than the world.
    #[error("the moment places {placed} bodies; the world has {bodies}")]
    Placements { placed: usize, bodies: usize },
    /// A body that is too near, or whose position is not finite.
    #[error("body '{body}' is at {distance} m; it can be drawn from {least:.2} m on")]
    TooNear { body: String, distance: f64, least: f64 },
}
