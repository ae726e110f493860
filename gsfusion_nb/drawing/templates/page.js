const box=document.getElementById('zoom');
document.addEventListener('click',event=>{const img=event.target.closest('figure img');if(!img)return;
box.firstElementChild.src=img.src;box.firstElementChild.alt=img.alt;box.showModal();});
box.addEventListener('click',()=>box.close());
