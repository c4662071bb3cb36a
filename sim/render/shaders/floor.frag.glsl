#version 330
// Tiles of two greys with a faint grain, and the lamp's shadows on them.

uniform vec3 ambient;    // with the lamp's tint
uniform vec3 diffuse;    // with the lamp's tint and its cosine on the floor
uniform vec3 rgb;
uniform vec3 other_rgb;
uniform float tile_m;
uniform sampler2DShadow lamp_map;

in vec2 place;
in vec3 lamp_place;

out vec4 colour;

// -0.5 to 0.5, another value for each cell (an integer hash: the sine of the textbooks costs half the pass).
float grain(ivec2 cell) {
    uint h = uint(cell.x) * 0x8da6b343u ^ uint(cell.y) * 0xd8163841u;
    h = (h ^ (h >> 13)) * 0x9e3779b1u;
    return float(h >> 24) / 255.0 - 0.5;
}

void main() {
    ivec2 tile = ivec2(floor(place / tile_m));
    vec3 shade = ((tile.x + tile.y) & 1) == 0 ? rgb : other_rgb;
    // Cells of 2 cm; they fade from 1.3 to 4 m, where a pixel comes to cover several, or they would flicker.
    float near = clamp(2.0 * gl_FragCoord.w - 0.5, 0.0, 1.0);
    shade += 0.03 * near * grain(ivec2(floor(place * 50.0)));
    float lit = texture(lamp_map, vec3(lamp_place.xy, min(lamp_place.z, 1.0)));  // beyond the map all is lit
    colour = vec4(shade * (ambient + diffuse * lit), 1.0);
}
