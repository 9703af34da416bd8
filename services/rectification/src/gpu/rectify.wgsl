// Square gnomonic views of an equirectangular sphere image: four pixels for each invocation.
// The same arithmetic as flockeye_imaging::sphere, with the exact mapping at every pixel.

struct Sphere {
    width: u32,
    height: u32,
    // Bytes from one row to the next.
    stride: u32,
    reserved: u32,
}

struct View {
    // Direction of the pixel `start` in the camera frame, in units of the view's pixels.
    direction: vec3f,
    size: u32,
    // From one pixel to its right neighbour.
    right: vec3f,
    words_per_row: u32,
    // From one pixel to the one below.
    down: vec3f,
    // The view's first word in the output.
    first_word: u32,
    start: vec2i,
    reserved: vec2u,
}

@group(0) @binding(0) var<uniform> sphere: Sphere;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read> luma: array<u32>;
@group(0) @binding(3) var<storage, read_write> output: array<u32>;

const PI = 3.14159265358979;

// Abramowitz and Stegun 4.4.49, |t| <= 1. (The built-in atan2 may be off by 4096 units in the last
// place, half a pixel.)
fn atan_unit(t: f32) -> f32 {
    let s = t * t;
    var sum = 0.0028662257;
    sum = sum * s - 0.0161657367;
    sum = sum * s + 0.0429096138;
    sum = sum * s - 0.0752896400;
    sum = sum * s + 0.1065626393;
    sum = sum * s - 0.1420889944;
    sum = sum * s + 0.1999355085;
    sum = sum * s - 0.3333314528;
    return t + t * (sum * s);
}

fn angle(y: f32, x: f32) -> f32 {
    let across = abs(y);
    let along = abs(x);
    let more = max(across, along);
    let first = atan_unit(min(across, along) / select(1.0, more, more > 0.0));
    let quarter = select(first, 0.5 * PI - first, across > along);
    let half_turn = select(quarter, PI - quarter, x < 0.0);
    return select(half_turn, -half_turn, y < 0.0);
}

// Column and row, 1/65536 px.
fn position(direction: vec3f) -> vec2i {
    let longitude = angle(direction.y, direction.x);
    let latitude = angle(direction.z, length(direction.xy));
    let sides = vec2f(f32(sphere.width), f32(sphere.height));
    let turned = vec2f(longitude / (2.0 * PI), latitude / PI) * sides;
    return vec2i(floor((sides * 0.5 - 0.5 - turned) * 65536.0 + 0.5));
}

// Grey less 128: rows beyond the poles come back half a turn further, columns go round.
fn grey(x: i32, y: i32) -> i32 {
    let width = i32(sphere.width);
    let height = i32(sphere.height);
    let is_above = y < 0;
    let is_below = y >= height;
    let row = clamp(select(select(y, 2 * height - 1 - y, is_below), -1 - y, is_above), 0, height - 1);
    let turned = x + select(0, width / 2, is_above || is_below) + width;
    let column = turned % width;
    let at = u32(row) * sphere.stride + u32(column);
    return i32((luma[at >> 2u] >> (8u * (at & 3u))) & 0xffu) - 128;
}

fn sample(at: vec2i) -> u32 {
    let first = at >> vec2u(16u);
    let right = (at.x >> 8u) & 0xff;
    let down = at.y & 0xffff;
    let upper = (255 - right) * grey(first.x, first.y) + right * grey(first.x + 1, first.y);
    let lower = (255 - right) * grey(first.x, first.y + 1) + right * grey(first.x + 1, first.y + 1);
    let above = ((0xffff - down) * 16450) >> 16u;
    let below = (down * 16450) >> 16u;
    return u32((upper * above + lower * below + 538968064) >> 22u);
}

@compute @workgroup_size(8, 8)
fn rectify(@builtin(global_invocation_id) id: vec3u) {
    let view = views[id.z];
    if id.x >= view.words_per_row || id.y >= view.size {
        return;
    }
    var word = 0u;
    for (var k = 0u; k < 4u; k += 1u) {
        let step = vec2f(vec2i(i32(4u * id.x + k), i32(id.y)) - view.start);
        let direction = view.direction + step.x * view.right + step.y * view.down;
        word |= sample(position(direction)) << (8u * k);
    }
    output[view.first_word + id.y * view.words_per_row + id.x] = word;
}
