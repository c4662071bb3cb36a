#version 330
// Metres along the optical axis; negative where the projector's light is blocked.

uniform sampler2DShadow projector_map;

in vec4 projector_place;

out float depth;

void main() {
    vec3 place = projector_place.xyz / projector_place.w * 0.5 + 0.5;
    bool lit = texture(projector_map, vec3(place.xy, min(place.z, 1.0))) > 0.5;
    float depth_m = 1.0 / gl_FragCoord.w;  // the fourth row of the projection is the optical axis
    depth = lit ? depth_m : -depth_m;
}
