#version 330
// Metres along the optical axis; negative where the projector's light is blocked.

uniform bool projecting;
uniform sampler2DShadow projector_map;

in float depth_m;
in vec4 projector_place;

out float depth;

void main() {
    bool lit = true;
    if (projecting) {
        vec3 place = projector_place.xyz / projector_place.w * 0.5 + 0.5;
        lit = texture(projector_map, place) > 0.5;
    }
    depth = lit ? depth_m : -depth_m;
}
