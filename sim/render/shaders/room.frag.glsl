#version 330
// Floor tiles with a faint grain, plain walls with a skirting board, a ceiling.

uniform vec3 ambient;
uniform vec3 diffuse;
uniform vec3 to_lamp;
uniform vec3 eye;
uniform vec3 floor_rgb;
uniform vec3 floor_other_rgb;
uniform vec3 wall_rgb;
uniform vec3 skirting_rgb;
uniform vec3 ceiling_rgb;
uniform float tile_m;
uniform float skirting_m;
uniform sampler2DShadow lamp_map;

in vec3 place;
flat in vec3 normal;
in vec3 lamp_place;

out vec4 colour;

float grain(vec2 cell) {
    return fract(sin(dot(cell, vec2(12.9898, 78.233))) * 43758.547) - 0.5;
}

void main() {
    vec3 rgb;
    float lit = max(dot(normal, to_lamp), 0.0);
    if (normal.z > 0.5) {
        vec2 tile = floor(place.xy / tile_m);
        rgb = mix(floor_rgb, floor_other_rgb, mod(tile.x + tile.y, 2.0));
        // Cells of 2 cm; they fade where a pixel covers several, or they would flicker.
        float near = clamp(2.0 - 0.5 * distance(place, eye), 0.0, 1.0);
        rgb += 0.03 * near * grain(floor(place.xy * 50.0));
        lit *= texture(lamp_map, lamp_place);
    } else if (normal.z < -0.5) {
        rgb = ceiling_rgb;
        lit = 0.5;
    } else {
        rgb = place.z < skirting_m ? skirting_rgb : wall_rgb;
        lit = 0.3 + 0.5 * lit;
    }
    colour = vec4(rgb * (ambient + diffuse * lit), 1.0);
}
